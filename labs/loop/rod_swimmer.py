"""The hardware of the virtual laboratory: a starfish of extensible rods, in plain numpy.

Shares no code with the simulator that is fitted to it, and is of another kind: every leg is a
discrete elastic rod of ``NUM_EDGES`` straight pieces with stretch and bending, integrated
explicitly (symplectic Euler) at ``DT``, where the simulator has hexahedra and implicit Euler at
1/60 s. What it has and the simulator has not:

- four legs that differ by some per cent, so that markers of the upper and the lower leg differ;
- foam that relaxes (a Maxwell branch) and stiffens with curvature;
- a cable that slides in its sheath with capstan friction, with slack;
- water that is carried along (drag on velocity less that of a lagging wake, and inertia across
  the legs only), with other drag laws: crossflow and skin friction of a rod;
- Coulomb friction on the rail, a current.

Not modeled: twist, bending out of a leg's plane, pitch and heave of the robot, wakes that meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NUM_EDGES = 6  # pieces per leg
STEPS_PER_SAMPLE = 90
DT = 1.0 / (60.0 * STEPS_PER_SAMPLE)  # [s]
ROOT, TIP, WIDTH, CORE_SIDE, CORE_THICK = 0.018, 0.070, 0.015, 0.036, 0.0175  # [m]
THICK_AT, THICK = (0.0, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07), (17.5, 17, 15.6, 13.3, 11, 9.1, 6.3)
CABLE_DEPTH = 1.5e-3  # under the flat side [m]
WATER = 1000.0  # [kg/m^3]
CABLE_SPEED = 5e-3  # of the cable, beyond which its friction has all of its direction [m/s]


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What only the laboratory knows, SI units."""

    youngs_modulus: float = 4.3e5  # modulus of the relaxed foam [Pa]
    density: float = 990.0  # ballasted to float [kg/m^3]
    # relaxing_share, relaxation_s: maxwell branch: its stiffness over the relaxed modulus, and its
    # time
    relaxing_share: float = 0.35
    relaxation_s: float = 0.06
    stiffening: float = 0.4  # moment times 1 + this turning angle squared
    viscous_s: float = 1.5e-4  # Kelvin-Voigt time [s]
    cable_stiffness: float = 9e3  # [N/m], cable with sheath and servo arm
    capstan: float = 0.12  # friction of the cable on the foam [-]
    slack_m: float = 4e-4  # pull that moves nothing [m]
    # crossflow_flat, crossflow_top: drag coefficients of a leg that moves towards its flat side and
    # towards its top [-]
    crossflow_flat: float = 2.1
    crossflow_top: float = 1.5
    skin: float = 0.02  # friction coefficient along a leg [-]
    core_drag: float = 1.1  # drag coefficient of the core [-]
    # inertia across a leg, over that of a water cylinder of the leg's width [-]
    added: float = 0.85
    # wake_share, wake_s: water takes that share of the leg's velocity, so late [s]
    wake_share: float = 0.2
    wake_s: float = 0.12
    rail_friction: float = 2e-3  # Coulomb [N]
    current: float = 0.0  # velocity of the tank's water along x [m/s]
    # (4,) factors: upper, lower, two sides
    leg_stiffness: tuple[float, float, float, float] = (1.03, 0.96, 1.01, 0.99)


@dataclass
class RodState:
    """The robot in motion; places, momenta and velocities along x and outwards."""

    at: Array  # (4, NUM_EDGES + 1, 2) places of the rods [m]
    momentum: Array  # (4, NUM_EDGES, 2) of the nodes beyond the core [kg m/s]
    velocity: Array  # (4, NUM_EDGES + 1, 2) [m/s]
    relaxed: Array  # (4, NUM_EDGES) turn at which the Maxwell branch rests [rad]
    wake: Array  # (4, NUM_EDGES) velocity of the water that is carried along [m/s]
    core_momentum: float = 0.0  # along x [kg m/s]
    pull: float = 0.0  # of the servo arm, last [m]


class RodSwimmer:
    """The robot on its rail; ``run`` makes a motion from the pull of the servo.

    Places are (x, r): along the rail, swimming towards -x, and outwards along a leg.

    Args:
        truth: Properties of the laboratory.
    """

    def __init__(self, truth: Truth):
        self.truth = truth
        r = np.linspace(ROOT, TIP, NUM_EDGES + 1)
        thick = 1e-3 * np.interp(r, THICK_AT, THICK)
        self.rest = np.stack([-0.5 * thick, r], 1)  # the rod's axis; the flat side is x = 0
        edges = np.diff(self.rest, axis=0)
        self.length = np.hypot(*edges.T)
        angle = np.arctan2(edges[:, 0], edges[:, 1])
        self.root_angle = angle[0]
        self.rest_turn = np.diff(angle, prepend=self.root_angle)
        middle = 0.5 * (thick[1:] + thick[:-1])
        legs = np.asarray(truth.leg_stiffness)[:, None]
        modulus = truth.youngs_modulus * legs
        self.axial = modulus * WIDTH * middle
        spacing = 0.5 * (self.length + np.append(self.length[0], self.length[:-1]))
        self.bending = modulus * WIDTH * thick[:-1] ** 3 / 12.0 / spacing
        self.lever = 0.5 * thick[:-1] - CABLE_DEPTH
        share = 0.5 * np.append(self.length[:-1] + self.length[1:], self.length[-1])
        self.mass = truth.density * WIDTH * thick[1:] * share
        self.entrained = truth.added * WATER * np.pi / 4.0 * WIDTH**2 * share
        self.half_perimeter = WIDTH + middle
        self.core_mass = truth.density * CORE_THICK * CORE_SIDE**2
        self.core_mass += 8.0 / 3.0 * WATER * (0.5 * CORE_SIDE) ** 3 * truth.added

    def run(self, pull: Array) -> Array:
        """Motion from rest.

        Args:
            pull: (num_steps,) of the servo arm at every ``DT`` [m].

        Returns:
            (num_samples, 4, NUM_EDGES + 1, 2) places of the rods, 60 a second [m].
        """
        direction = np.tanh(np.gradient(pull, DT) / CABLE_SPEED)
        path = np.maximum(pull - self.truth.slack_m, 0.0)
        now, kept = self.rest_state(), []
        for k in range(len(pull)):
            if k % STEPS_PER_SAMPLE == 0:
                kept.append(now.at.copy())
            self._step(now, path[k], direction[k])
        return np.array(kept)

    def rest_state(self) -> RodState:
        """The robot at rest, as :meth:`follow` moves it on."""
        return RodState(
            at=np.tile(self.rest, (4, 1, 1)),
            momentum=np.zeros((4, NUM_EDGES, 2)),
            velocity=np.zeros((4, NUM_EDGES + 1, 2)),
            relaxed=np.zeros((4, NUM_EDGES)),
            wake=np.zeros((4, NUM_EDGES)),
        )

    def follow(self, now: RodState, pull: Array) -> None:
        """Move a state on, so that nothing of the pull after this need be known.

        Args:
            now: Changed in place.
            pull: (num_steps,) of the servo arm at the next steps of ``DT`` [m].
        """
        direction = np.tanh(np.diff(pull, prepend=now.pull) / (DT * CABLE_SPEED))
        path = np.maximum(pull - self.truth.slack_m, 0.0)
        for k in range(len(pull)):
            self._step(now, path[k], direction[k])
        now.pull = float(pull[-1])

    def _step(self, now: RodState, path: float, direction: float) -> None:
        """One step of ``DT`` under a pull without its slack; ``direction`` -1 to 1 of the cable."""
        t = self.truth
        edge = now.at[:, 1:] - now.at[:, :-1]
        length = np.sqrt((edge * edge).sum(-1))
        along = edge / length[..., None]
        across = np.stack([along[..., 1], -along[..., 0]], -1)
        middle = 0.5 * (now.velocity[:, 1:] + now.velocity[:, :-1])
        middle[..., 0] -= t.current
        fast = now.velocity[:, 1:] - now.velocity[:, :-1]
        angle = np.arctan2(along[..., 0], along[..., 1])
        turn = angle.copy()
        turn[:, 0] -= self.root_angle
        turn[:, 1:] -= angle[:, :-1]
        turn -= self.rest_turn
        inner = self._tendon_and_foam(
            length, turn, now.relaxed, fast, along, across, path, direction
        )
        force = inner + self._water(middle, along, across, now.wake)
        # pushes at both ends of a piece: inner forces are opposite, those of the water equal
        on_core = float((0.5 * (force - inner) - inner)[:, 0, 0].sum())
        nodal = inner + 0.5 * (force - inner)
        nodal[:, :-1] += (0.5 * (force - inner) - inner)[:, 1:]
        speed = float(now.velocity[0, 0, 0])
        on_core -= t.rail_friction * np.tanh(speed / 5e-4)
        past = speed - t.current
        on_core -= 0.5 * WATER * t.core_drag * CORE_SIDE**2 * abs(past) * past
        now.momentum += DT * nodal
        now.core_momentum += DT * on_core
        self._move(now.at, now.velocity, now.momentum, across, now.core_momentum)

    def _tendon_and_foam(
        self,
        length: Array,
        turn: Array,
        relaxed: Array,
        fast: Array,
        along: Array,
        across: Array,
        pull: float,
        direction: float,
    ) -> Array:
        """Force of each piece on its outer end, (4, NUM_EDGES, 2) [N]; advances ``relaxed``."""
        t = self.truth
        stretched = (length - self.length).sum(1) - (self.lever * turn).sum(1) + pull
        tension = t.cable_stiffness * np.maximum(stretched, 0.0)
        wrapped = np.cumsum(np.abs(turn), axis=1)
        cable = tension[:, None] * np.exp(-direction * t.capstan * wrapped)
        relaxed += (DT / t.relaxation_s) * (turn - relaxed)
        spin = (fast * across).sum(-1) / length
        turning = spin.copy()
        turning[:, 1:] -= spin[:, :-1]
        moment = self.bending * (
            turn * (1.0 + t.stiffening * turn**2)
            + t.relaxing_share * (turn - relaxed)
            + t.viscous_s * turning
        )
        moment -= cable * self.lever
        net = moment.copy()
        net[:, :-1] -= moment[:, 1:]
        strain = length / self.length - 1.0 + t.viscous_s * (fast * along).sum(-1) / self.length
        tensile = self.axial * strain + cable
        return np.asarray(-tensile[..., None] * along - (net / length)[..., None] * across)

    def _water(self, middle: Array, along: Array, across: Array, wake: Array) -> Array:
        """Force on each piece, (4, NUM_EDGES, 2) [N]; advances ``wake``."""
        t = self.truth
        normal, tangential = (middle * across).sum(-1), (middle * along).sum(-1)
        past = normal - wake
        wake += (DT / t.wake_s) * (t.wake_share * normal - wake)
        coefficient = np.where(past > 0.0, t.crossflow_flat, t.crossflow_top)
        push = 0.5 * WATER * WIDTH * self.length * coefficient * np.abs(past) * past
        rub = WATER * self.half_perimeter * self.length * t.skin * np.abs(tangential) * tangential
        return np.asarray(-push[..., None] * across - rub[..., None] * along)

    def _move(
        self, at: Array, velocity: Array, momentum: Array, across: Array, core_momentum: float
    ) -> None:
        """Velocities from momenta (water is inert across a leg only), and a step of places."""
        normal = across.copy()
        normal[:, :-1] += across[:, 1:]
        normal /= np.sqrt((normal * normal).sum(-1))[..., None]
        heavy = self.entrained / (self.mass + self.entrained)
        less = heavy * (momentum * normal).sum(-1)
        velocity[:, 1:] = (momentum - less[..., None] * normal) / self.mass[:, None]
        velocity[:, 0, 0] = core_momentum / self.core_mass
        at += DT * velocity

    def flat_side(self, places: Array, leg: int, r: float) -> Array:
        """Places (num_samples, 2) of a marker on the flat side of a leg, ``r`` from the center."""
        i = int(np.clip(np.searchsorted(self.rest[:, 1], r) - 1, 0, NUM_EDGES - 1))
        from_node = np.array([0.0, r]) - self.rest[i]
        edge = self.rest[i + 1] - self.rest[i]
        share = from_node @ edge / self.length[i] ** 2
        height = (edge[1] * from_node[0] - edge[0] * from_node[1]) / self.length[i]
        now = places[:, leg, i + 1] - places[:, leg, i]
        unit = now / np.hypot(*now.T)[:, None]
        across = np.stack([unit[:, 1], -unit[:, 0]], 1)
        return np.asarray(places[:, leg, i] + share * now + height * across)
