"""How strongly and how fast must a quadruped bend its legs to come far in a second?

Thesis 4.1.6, "Quadruped", Fig. 4-14: a soft slab on four legs with a muscle along the front and
one along the back of each. One sinusoid bends all legs at once; its frequency and the strengths of
fronts and backs are the three parameters. 648 elements, a second.

The thesis takes 100 steps of 10 ms. A hop is a sequence of impacts, and implicit Euler damps it as
a material with a relaxation time of one step would: in a material of none the way depends on the
step as much as on the signal. So ours has 20 ms, and steps of an eighth of that; and the loss is
the mean of the way at this step and at half of it. The search begins at the signal that came
farthest at 2.5 and 0.625 ms of some twenty.

    python examples/applications/quadruped.py  # diffsim examples run quadruped
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import numpy as np

from diffsim import soft
from diffsim.systems import robots
from examples.applications import Application
from examples.applications.command import main
from examples.applications.gait import gait, signal, sinusoid, strong

RTOL, MAX_EVALUATIONS = 1e-4, 25
DT, STEPS = 0.0025, 400  # [s]


def build(
    solver: soft.SolverOptions,
    quick: bool,
    refine: int = 1,
    cells: int = 1,
    half: bool = False,
) -> Application:
    """The quadruped of 1 cm cubes (quick: 1.8 cm), stiffer and with a longer stroke than elsewhere.

    ``refine`` time steps are made of one, and ``cells`` elements along each edge of
    one, to see what they do. ``half`` takes the left half alone, exact for this gait.
    """
    dt, steps = DT / refine, STEPS * refine
    robot, also = strong(robots.quadruped, dt, coarse=quick, refine=cells, half=half), []
    if not quick:
        finer = strong(robots.quadruped, 0.5 * dt, coarse=False, refine=cells, half=True)
        also = [(finer, sinusoid(0.5 * dt, 2 * steps))]
    return gait(
        robot,
        solver,
        signal(np.array([0.5, 0.4, 6.0] if quick else [0.9, 0.1, 6.8])),
        sinusoid(dt, steps),
        title="A soft slab on four legs comes far",
        source="thesis Fig. 4-14",
        scale=10.0,
        num_starts=8 if quick else 1,  # most random signals go nowhere, or backward
        also=also,
    )


if __name__ == "__main__":
    with interruptible():
        main(build, __doc__, rtol=RTOL, max_evaluations=MAX_EVALUATIONS, view=(10.0, -82.0))
