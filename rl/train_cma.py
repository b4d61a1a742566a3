"""Search an open-loop controller with few parameters by CMA-ES.

python rl/train_cma.py --task SharkSwim --task-options '{"robot": {"coarse": true}}' --seed 0
python rl/train_cma.py --kind knots --task StarfishSwim
python rl/train_cma.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Sequence

from diffsim.learn import CmaLearner, CmaOptions, Run
from rl.arguments import main_training

QUICK = {"population": 4}


def main(argv: Sequence[str] | None = None) -> Run:
    """Run; see the module."""
    return main_training("cma", CmaLearner, CmaOptions, QUICK, __doc__, argv)


if __name__ == "__main__":
    with interruptible():
        main()
