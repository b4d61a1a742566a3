"""Train a controller with sb3-contrib's TQC on the native vector environment.

python rl/train_tqc.py --task SharkSwim --seed 0 --steps 14000
python rl/train_tqc.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import Run, TqcLearner, TqcOptions
from rl.arguments import main_training

QUICK = {"envs": 8, "rollout": 10, "passes": 2, "minibatch": 40, "first": 80, "keep": 1_000}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("tqc", TqcLearner, TqcOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
