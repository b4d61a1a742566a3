"""Train a controller with stable-baselines3's PPO on the native vector environment.

python rl/train_ppo.py --task CopterHover --seed 0 --steps 500000
python rl/train_ppo.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import PpoLearner, PpoOptions, Run
from rl.arguments import main_training

QUICK = {"envs": 8, "rollout": 10, "minibatch": 40, "epochs": 2}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("ppo", PpoLearner, PpoOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
