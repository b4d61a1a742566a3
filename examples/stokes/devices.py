"""How good do the other fluidic devices of thesis table 4.5 get, and what does a flow cost?

Random designs are drawn, the best one is improved by L-BFGS. Losses are normalised: 1 for an
average random design, 0 for a perfect device. The thesis gives neither coordinates nor bumps nor
target profiles, so that its losses compare problems of the same kind, not the same ones.

Expected, with seed 0 (amplifier: see ``amplifier.py``):

    options beside --out                                               loss    thesis
    averager                                                           0.025   0.031
    gate                                                               0.45    0.49
    funnel --resolution 0.5                                            0.049   0.23
    twister --resolution 0.5                                           0.0009  0.049
    twister --no-slip --resolution 0.375 --samples 12 --evaluations 15 0.95    0.97
    switch --resolution 0.3125 --samples 10 --evaluations 40           0.27    0.58

On the thesis's grids, funnel, twister and switch found so had losses of 0.048, 0.034 and 0.23, in
the same unit (before slip walls were mended). There, one loss with gradient takes, in CPU seconds
of one thread (thesis, wall seconds): averager 0.69 (5.3), gate 0.71 (4.9), funnel 13.7 (64.8),
twister 14.1 (56.1), switch, two positions, 55 (171). Running time of each line: 1/2 to 3 CPU
minutes.

    python examples/stokes/devices.py averager --out runs/averager
"""

from __future__ import annotations

import sys

from diffsim.stokes.devices.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
