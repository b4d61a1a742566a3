"""Gaits: a robot's muscles follow a signal of few parameters, and it should come far (4.1.6)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim import soft
from diffsim.systems.robots import SoftRobot
from examples.applications.application import Application, Array, Parameters

Commands = Callable[[Tensor], Tensor]
"""Parameters (num_parameters,) -> command of every step, (num_steps, num_commands)."""


def gait(
    robot: SoftRobot,
    solver: soft.SolverOptions,
    parameters: Parameters,
    commands: Commands,
    *,
    title: str,
    source: str,
    rise_weight: float = 0.0,
    scale: float,
    num_starts: int = 1,
    also: Sequence[tuple[SoftRobot, Commands]] = (),
) -> Application:
    """The application of a robot that should come far along +x from rest.

    The loss is minus the center's x at the end, and minus ``rise_weight`` times its z (thesis
    4.1.6: 0.3 for the cow), both from where they were at the start [m].

    Args:
        robot: Body, muscles, floor.
        solver: Solver of the robot's steps; replaces the robot's own.
        parameters: Parameters of the signal.
        commands: Maps parameters (num_parameters,): the command of every step, in [-1, 1],
            (num_steps, num_commands).
        title, source, scale, num_starts: The same as in
            :class:`~examples.applications.Application`.
        rise_weight: Weight of the rise in the loss [-].
        also: The same robot at other time steps or on other meshes, each with its commands. The
            loss is the mean over all of them, so that what only one time step can do is not worth
            much.
    """
    versions = [(robot, commands), *also]
    for one, _ in versions:
        one.body.solver = solver
    start = robot.center(robot.body.x_rest)
    length = float(robot.body.x_rest[:, 0].max() - robot.body.x_rest[:, 0].min())

    def simulate(values: Tensor) -> Tensor:
        return _walk(robot, commands(values))

    def loss(values: Tensor, x: Tensor) -> Tensor:
        ends = [(robot, x[-1])]
        ends += [(one, _walk(one, made(values))[-1]) for one, made in also]
        moved = torch.stack([one.center(end) - one.center(one.body.x_rest) for one, end in ends])
        return (-moved[:, 0] - rise_weight * moved[:, 2]).mean()

    def numbers(_values: Array, x: Tensor) -> Mapping[str, float]:
        moved = robot.center(x[-1]) - start
        axis = robot.upright_axis
        upright = robot.attitude(x)[:, axis, axis].clamp(-1.0, 1.0)
        return {
            "travel mm": 1e3 * float(moved[0]),
            "travel body lengths": float(moved[0]) / length,
            "drift mm": 1e3 * float(moved[1]),
            "rise mm": 1e3 * float(moved[2]),
            "largest tilt degrees": math.degrees(math.acos(float(upright.min()))),
            "turned degrees": _measure_turn(robot.attitude(x)),
        }

    return Application(
        name=robot.name,
        title=title,
        source=source,
        body=robot.body,
        parameters=parameters,
        simulate=simulate,
        loss=loss,
        numbers=numbers,
        oracle=None,
        obstacles=robot.obstacles,
        scale=scale,
        num_starts=num_starts,
    )


def _walk(robot: SoftRobot, command: Tensor) -> Tensor:
    """Positions of all steps from rest, (num_steps + 1, num_nodes, 3) [m]."""
    activation = robot.activation(command)
    return soft.rollout(
        robot.body,
        robot.body.rest_state(),
        len(activation),
        activation=lambda k, _state: activation[k],
        obstacles=robot.obstacles,
    ).x


def sinusoid(dt: float, num_steps: int) -> Commands:
    """Commands of (front strength, back strength, frequency [Hz]) of a legged robot.

    One sinusoid bends all legs: the fronts of the legs follow it, the backs its negative, each by
    their own strength (thesis 4.1.6, "Quadruped"). It is read at the end of a step, as the forces
    of implicit Euler are.
    """
    time = dt * torch.arange(1, num_steps + 1, dtype=torch.float64)

    def commands(values: Tensor) -> Tensor:
        wave = torch.sin(2.0 * math.pi * values[2] * time)
        return wave[:, None] * torch.stack([values[0], -values[1]])

    return commands


def signal(first: Array) -> Parameters:
    """Parameters of :func:`sinusoid` with bounds.

    Args:
        first: Where the search begins: front strength, back strength, frequency [Hz].
    """
    return Parameters(
        names=("front strength", "back strength", "frequency Hz"),
        lower=np.array([0.0, 0.0, 2.0]),
        upper=np.array([1.0, 1.0, 9.0]),
        first=first,
    )


def strong(
    make: Callable[..., SoftRobot], dt: float, *, coarse: bool, refine: int, half: bool
) -> SoftRobot:
    """A legged robot stiff enough to push itself off the floor, whatever the time step.

    With a robot's default of 0.1 MPa and a stroke of 0.3 the legs give way. A hop is a sequence of
    impacts, which implicit Euler damps; a relaxation time of 20 ms leaves little to the time step.

    Args:
        make: ``quadruped`` or ``cow`` of :mod:`diffsim.systems.robots`.
        dt: Time step [s].
        coarse: Elements of twice the edge.
        refine: Elements along each edge of one.
        half: Left half alone, exact for a gait of :func:`sinusoid`.
    """
    return make(
        coarse=coarse,
        dt=dt,
        youngs_modulus=3e5,
        amplitude=0.5,
        per_muscle=False,
        damping=0.02,
        refine=refine,
        half=half,
    )


def lines_between_knots(num_knots: int, num_steps: int) -> Commands:
    """Commands that run straight between evenly spaced knots, the last at the end.

    Of (num_knots x num_commands,) values, knot by knot.
    """
    place = torch.linspace(0.0, num_knots - 1.0, num_steps, dtype=torch.float64)
    hats = (1.0 - (place[:, None] - torch.arange(num_knots)).abs()).clamp(min=0.0)
    return lambda values: hats @ values.reshape(num_knots, -1)


def _measure_turn(attitude: Tensor) -> float:
    """How far the x-z plane has turned, from +z towards +x, over (num_steps + 1, 3, 3) [degrees].

    Counted on over full turns; a step must turn by less than half of one.
    """
    angle = torch.atan2(attitude[:, 0, 2], attitude[:, 2, 2])
    step = (angle.diff() + math.pi) % (2.0 * math.pi) - math.pi
    return math.degrees(float(step.sum()))
