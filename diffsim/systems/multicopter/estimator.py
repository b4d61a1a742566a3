"""State estimators on board that know no drag: they show other velocities and attitudes.

A Kalman filter that is told the position, integrates its gyro and takes thrust and gravity for all
forces blames what drag does on its state. With e, the error of its velocity, and d, the small
rotation of its attitude in the world,

    e' = d x f + size v - a e,    d' = -(b, b, c) (f x e),

v the true velocity along the ground, f the specific force of the thrust. Positions are told so
often that they are taken as right. In straight swings e is largest at the frequency g sqrt(b); in a
steady turn drag looks like an error of heading and goes into d.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.rotation import cross, matrix_from_rpy


@dataclass(frozen=True, eq=False)
class BlindEstimator:
    """Errors of an estimator along a flight, north-east-down."""

    drag: Tensor  # what it does not know, force over mass and velocity, (points,) [1/s]
    gains: Tensor  # a [1/s], b and c [s^2/m^2] as above, (points, 3)
    # of velocity [m/s] and attitude [rad] at every sample, by what was recorded until then,
    # (points, num_samples, 2, 3)
    errors: Tensor

    @classmethod
    def of(
        cls,
        states: Tensor,
        acceleration: Tensor,
        force: Tensor,
        dt: float,
        known: tuple[Tensor, Tensor],
    ) -> BlindEstimator:
        """From a record: velocity, attitude and thrust until each sample.

        Before the record the motion is taken to have gone on as a steady swing.

        Args:
            states: Recorded states of 12, (num_samples, 12).
            acceleration: Recorded, (num_samples, 3) [m/s^2].
            force: As ``force_of`` says, (points, num_samples, 3).
            dt: Time between two samples [s].
            known: Drag and gains, as above.
        """
        drag, gains = known
        velocity = states[None, :, 6:9]
        blind = cls(drag, gains, velocity.new_zeros(1))
        square = (_project_to_ground(acceleration) ** 2).sum() / (
            _project_to_ground(velocity) ** 2
        ).sum().clamp(min=1e-12)
        # [rad/s]: of a slower motion there is no error to speak of
        frequency = square.sqrt().clamp(min=0.1)[None]
        start = blind._compute_steady_swing(velocity[0, :1], acceleration[:1], frequency)[:, 0]
        # the record shows the sum of velocity and error: what drives is less by the error
        shown = (drag, gains[:, 0] + drag, gains)
        return cls(drag, gains, _follow_errors(velocity, force[:, :-1], start, shown, dt))

    def by_state_alone(self, states: Tensor, force: Tensor, share: float = 1.0) -> BlindEstimator:
        """With errors that follow from each sample by itself, whatever was before.

        They are a share of those of a steady swing at the estimator's own frequency, g sqrt(b),
        where they are largest.

        Args:
            states: Recorded states of 12, (num_samples, 12).
            force: As ``force_of`` says, (points, num_samples, 3).
            share: That flights have of it on average [-].
        """
        gravity = force.new_tensor([0.0, 0.0, GRAVITY])
        frequency = GRAVITY * self.gains[:, 1].sqrt()
        errors = self._compute_steady_swing(states[:, 6:9], (force + gravity)[0], frequency)
        return BlindEstimator(self.drag, self.gains, share * errors)

    def in_windows(
        self, rows: Tensor, velocity: Tensor, force: Tensor, dt: float
    ) -> tuple[Tensor, Tensor]:
        """Errors of velocity and attitude at every step of windows.

        Args:
            rows: Samples that windows start from, (num_windows,).
            velocity: True, (points, num_windows, length + 1, 3).
            force: Specific force of the thrust over each step, (points, num_windows, length, 3).
            dt: Time between two steps [s].

        Returns:
            Twice (points, num_windows, length + 1, 3).
        """
        start = self.errors[:, rows]
        drag, gains = self.drag[:, None], self.gains[:, None]
        errors = _follow_errors(velocity, force, start, (drag, gains[..., 0], gains), dt)
        return errors[..., 0, :], errors[..., 1, :]

    def _compute_steady_swing(
        self, velocity: Tensor, acceleration: Tensor, frequency: Tensor
    ) -> Tensor:
        """Errors of steady swings that pass through states, (points, num_states, 2, 3).

        With e = E v and E = size s / (s^2 + a s + b g^2) at s = i w.

        Args:
            velocity, acceleration: Shown, (num_states, 3).
            frequency: w, (points or 1,) [rad/s].
        """
        along, change, s = (
            _project_to_ground(velocity),
            _project_to_ground(acceleration),
            1j * frequency,
        )
        known = s**2 + self.gains[:, 0] * s + self.gains[:, 1] * GRAVITY**2
        share = self.drag * s / (known + self.drag * s)  # of the shown velocity

        def of_swing(factor: Tensor) -> Tensor:
            factor = factor[:, None, None]
            return factor.real * along + (factor / frequency[:, None, None]).imag * change

        error, growth = of_swing(share), of_swing(s * share)
        drag = self.drag[:, None, None] * (along - error)
        lean = (growth - drag + self.gains[:, :1, None] * error) / GRAVITY  # d x f, over g
        turned = torch.stack([lean[..., 1], -lean[..., 0], torch.zeros_like(lean[..., 0])], -1)
        return torch.stack([error, turned], -2)


def force_of(states: Tensor, push: Tensor) -> Tensor:
    """Specific force of the thrust against the body's z axis, (points, num_samples, 3).

    Args:
        states: States of 12 at every sample, (num_samples, 12).
        push: Thrust of all rotors over mass, (points, num_samples) [m/s^2].
    """
    return -push[..., None] * matrix_from_rpy(states[:, 3:6])[..., 2]


def _follow_errors(
    velocity: Tensor,
    force: Tensor,
    start: Tensor,
    rates: tuple[Tensor, Tensor, Tensor],
    dt: float,
) -> Tensor:
    """Errors at every step, the start first, by explicit steps, (..., num_steps + 1, 2, 3).

    Args:
        velocity: Along the ground it pulls at the error, (..., num_steps or more, 3).
        force: Specific force of the thrust, (..., num_steps, 3).
        start: Errors of velocity and attitude, (..., 2, 3).
        rates: Drag (...), decay of the velocity's error (...), and gains (..., 3).
        dt: Time of a step [s].
    """
    drag, decay, gains = rates
    turning = torch.stack([gains[..., 1], gains[..., 1], gains[..., 2]], -1)
    pull = dt * drag[..., None, None] * _project_to_ground(velocity)[..., : force.shape[-2], :]
    error, attitude = start.unbind(-2)
    out = [start]
    for k in range(force.shape[-2]):
        thrust = force[..., k, :]
        lean = _project_to_ground(cross(attitude, thrust))
        change = dt * turning * cross(thrust, error)
        error = error + dt * lean + pull[..., k, :] - dt * decay[..., None] * error
        attitude = attitude - change
        out.append(torch.stack(torch.broadcast_tensors(error, attitude), -2))
    return torch.stack(torch.broadcast_tensors(*out), -3)


def _project_to_ground(vectors: Tensor) -> Tensor:
    """Vectors along the ground: their height is told by the accelerometer."""
    return vectors * vectors.new_tensor([1.0, 1.0, 0.0])
