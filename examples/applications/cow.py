"""How must a front-heavy cow bend its legs to come far in 0.6 s without falling on its face?

Thesis 4.1.6, "Cow", Fig. 4-15: the muscles and the three parameters of the quadruped; the loss is
minus the way along x, minus 0.3 times the rise of the center of mass, which rewards an upright
gait. 456 elements of our own cow (the thesis's has 475). Its material has a relaxation time of
20 ms, as the quadruped's, and 300 steps of 2 ms are enough (the thesis takes 600 of 1 ms). The
search begins at the signal that came farthest of some dozen.

    python examples/applications/cow.py  # diffsim examples run cow
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import numpy as np

from diffsim import soft
from diffsim.systems import robots
from examples.applications import Application
from examples.applications.command import main
from examples.applications.gait import gait, signal, sinusoid, strong

RTOL, MAX_EVALUATIONS = 1e-6, 25  # the thesis's tolerance
DT, STEPS = 0.002, 300  # [s]
RISE_WEIGHT = 0.3


def build(
    solver: soft.SolverOptions,
    quick: bool,
    refine: int = 1,
    cells: int = 1,
    half: bool = False,
) -> Application:
    """The cow of 1 cm cubes (quick: 1.5 cm and steps of 4 ms), as stiff as the quadruped.

    ``refine`` time steps are made of one, and ``cells`` elements along each edge of one, to see
    what they do. ``half`` takes the left half alone, exact for this gait; it needs even ``cells``.
    """
    dt, steps = DT / refine, STEPS * refine
    if quick:
        dt, steps = 2.0 * dt, steps // 2
    return gait(
        strong(robots.cow, dt, coarse=quick, refine=cells, half=half),
        solver,
        signal(np.array([0.7, 0.1, 6.8])),
        sinusoid(dt, steps),
        title="A cow with a heavy head comes far, upright",
        source="thesis Fig. 4-15",
        rise_weight=RISE_WEIGHT,
        scale=5.0,
    )


if __name__ == "__main__":
    with interruptible():
        main(build, __doc__, rtol=RTOL, max_evaluations=MAX_EVALUATIONS, view=(10.0, -82.0))
