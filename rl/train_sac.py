"""Train a controller with stable-baselines3's SAC on the native vector environment.

python rl/train_sac.py --task CopterHover --seed 0 --steps 50000
python rl/train_sac.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import Run, SacLearner, SacOptions
from rl.arguments import main_training

QUICK = {"envs": 8, "rollout": 10, "passes": 2, "minibatch": 40, "first": 80, "keep": 1_000}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("sac", SacLearner, SacOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
