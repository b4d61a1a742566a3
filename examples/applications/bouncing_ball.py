"""How stiff and how compressible is a ball, seen bouncing for half a second?

Thesis 4.1.6, "Bouncing ball", Fig. 4-10: Young's modulus and Poisson's ratio (truth: 2 MPa, 0.4)
from the motion of a ball with three cylindrical holes that is thrown to the ground, 125 steps of
4 ms. 1,288 hexahedra and 8,280 DoF (thesis: 1,288 and 9,132). Contact is complementarity with a
friction of 0.5: with the thesis's floor, to which all that touches sticks, the loss jumps between
neighboring parameters and fits end beside the truth (docs/measured/applications.md). The data are
made with a tolerance of 1e-8, the fit's steps have 1e-4. The first bounce alone is fitted before
the whole motion. Expected of --quick: E = 2.09 MPa, nu = 0.34 after 8 evaluations.

    python examples/applications/bouncing_ball.py  # diffsim examples run bouncing_ball --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import math
from dataclasses import replace

import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from examples.applications import Application
from examples.applications.command import main
from examples.applications.identification import TRUTH_RTOL, identification

RTOL, MAX_EVALUATIONS = 1e-4, 40
TRUTH = (2e6, 0.4)  # Young's modulus [Pa], Poisson's ratio
LOWER, UPPER = (1e6, 0.2), (1e7, 0.45)
FIRST = (9.9e6, 0.4455)  # far from the truth, so that the first motion differs visibly
RADIUS, HOLE = 0.1, 0.055  # [m]
DT, STEPS, WARM_UP = 0.004, 125, 50  # [s], steps, steps of the first bounce
FRICTION = 0.5
ABOVE, SPEED = 0.07, (1.5, 0.5, -1.0)  # of the lowest point [m], first velocity [m/s]


def build(
    solver: soft.SolverOptions,
    quick: bool,
    truth_integrator: str = "implicit_euler",
    friction: float = FRICTION,
) -> Application:
    """The ball, 24 cells across, after a warm-up; quick: 12 cells, and only the warm-up's steps."""
    shape = holed_ball(12 if quick else 24)
    ground = (contact.floor(friction=friction),)

    def move(body: soft.SoftBody, physics: soft.Physics, steps: int) -> Tensor:
        v = torch.tensor(SPEED, dtype=torch.float64).expand_as(body.x_rest).contiguous()
        start = soft.State(body.x_rest, v)
        return soft.rollout(body, start, steps, obstacles=ground, physics=physics).x

    return identification(
        name="bouncing_ball",
        title="A ball's stiffness from its bounce",
        source="thesis Fig. 4-10",
        body=_body(shape, solver, "implicit_euler"),
        truth_body=_body(shape, replace(solver, rtol=TRUTH_RTOL), truth_integrator),
        move=move,
        steps=WARM_UP if quick else STEPS,
        warm_up_steps=None if quick else WARM_UP,
        truth=TRUTH,
        lower=LOWER,
        upper=UPPER,
        first=FIRST,
        obstacles=ground,
    )


def holed_ball(cells: int) -> mesh.HexMesh:
    """A ball of cubes, so many across, drilled along all axes, its lowest point ``ABOVE`` z = 0."""
    center = (0.0, 0.0, ABOVE + RADIUS)
    drill = mesh.sdf.cylinder(HOLE, 4.0 * RADIUS)
    drills = (
        drill,
        mesh.sdf.rotate(drill, (1.0, 0.0, 0.0), math.pi / 2),
        mesh.sdf.rotate(drill, (0.0, 1.0, 0.0), math.pi / 2),
    )
    solid = mesh.sdf.difference(mesh.sdf.sphere(RADIUS), *drills)
    bounds = ([c - RADIUS for c in center], [c + RADIUS for c in center])
    return mesh.hex_from_sdf(mesh.sdf.translate(solid, center), bounds, 2.0 * RADIUS / cells)


def _body(shape: mesh.HexMesh, solver: soft.SolverOptions, integrator: str) -> soft.SoftBody:
    return soft.SoftBody(
        shape,
        dt=DT,
        youngs_modulus=TRUTH[0],
        poissons_ratio=TRUTH[1],
        density=1000.0,
        integrator=integrator,
        solver=solver,
    )


if __name__ == "__main__":
    with interruptible():
        main(build, __doc__, rtol=RTOL, max_evaluations=MAX_EVALUATIONS)
