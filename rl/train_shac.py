"""Train a controller with the short-horizon actor-critic (Xu et al. 2022).

python rl/train_shac.py --task CopterHover --seed 0
python rl/train_shac.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import Run, ShacLearner, ShacOptions
from rl.arguments import main_training

QUICK = {"batch": 8, "window": 4, "critic_passes": 1}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("shac", ShacLearner, ShacOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
