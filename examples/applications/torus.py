"""In which order must a soft ring pull in its rim to roll as far as it can in 1.6 s?

Thesis 4.1.6, "Torus", Fig. 4-13: eight muscles around the rim, each led by 20 knots in time: 160
parameters. The best of 16 random signals is where L-BFGS begins. 400 steps of 4 ms, 576 elements of
our own ring (the thesis's has 568).

    python examples/applications/torus.py  # diffsim examples run torus
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import numpy as np

from diffsim import soft
from diffsim.systems import robots
from examples.applications import Application, Parameters
from examples.applications.command import main
from examples.applications.gait import gait, lines_between_knots

RTOL, MAX_EVALUATIONS = 1e-6, 25  # the thesis's tolerance
DT, STEPS, KNOTS = 0.004, 400, 20  # [s]


def build(solver: soft.SolverOptions, quick: bool, refine: int = 1, cells: int = 1) -> Application:
    """The ring (quick: a sixth of the elements, 0.8 s in steps of 8 ms, 10 knots, 4 starts).

    ``refine`` time steps are made of one, and ``cells`` elements along each edge of one, to see
    what they do.
    """
    dt, steps, knots = (0.008, 100, 10) if quick else (DT, STEPS, KNOTS)
    robot = robots.torus(coarse=quick, dt=dt / refine, refine=cells)
    count = knots * len(robot.command_names)
    return gait(
        robot,
        solver,
        Parameters(
            names=tuple(f"knot {k} of eighth {m}" for k in range(knots) for m in range(8)),
            lower=np.full(count, -1.0),
            upper=np.full(count, 1.0),
            first=np.random.default_rng(1).uniform(-1.0, 1.0, count),
        ),
        lines_between_knots(knots, steps * refine),
        title="A soft ring rolls far",
        source="thesis Fig. 4-13",
        scale=1.0,
        num_starts=4 if quick else 16,
    )


if __name__ == "__main__":
    with interruptible():
        main(build, __doc__, rtol=RTOL, max_evaluations=MAX_EVALUATIONS, view=(10.0, -82.0))
