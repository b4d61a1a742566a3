"""Train a controller with soft analytic policy optimization (SAPO, Xing et al. 2025).

python rl/train_sapo.py --task CopterHover --seed 0
python rl/train_sapo.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import Run, SapoLearner, SapoOptions
from rl.arguments import main_training

QUICK = {"batch": 8, "window": 4, "critic_passes": 1}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("sapo", SapoLearner, SapoOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
