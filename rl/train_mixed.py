"""Train a controller by a mix of first- and zeroth-order gradients (Suh et al. 2022).

python rl/train_mixed.py --task CopterHover --seed 0
python rl/train_mixed.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import MixedLearner, MixedOptions, Run
from rl.arguments import main_training

QUICK = {"batch": 8, "horizon": 0}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("mixed", MixedLearner, MixedOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
