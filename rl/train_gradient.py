"""Train a controller with Adam through the simulator; open-loop ones with L-BFGS.

Options not given are those of the task's recipe (``diffsim/learn/recipes.py``); with ``--plain``
they are those that ``--help`` shows.

python rl/train_gradient.py --task CopterHover --seed 0
python rl/train_gradient.py --task StarfishSwim --task-options '{"robot": {"coarse": true}}'
python rl/train_gradient.py --controller sinusoid --task SharkSwim   # L-BFGS, few parameters
python rl/train_gradient.py --quick
torchrun --nproc-per-node 2 rl/train_gradient.py --task CopterHover   # each batch on two processes
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import sys
from collections.abc import Sequence
from typing import Any

from diffsim.learn import GradientLearner, GradientOptions
from rl import open_loop
from rl.arguments import main_training

QUICK = {"batch": 8, "horizon": 0}


def main(argv: Sequence[str] | None = None) -> Any:
    """Run; see the module."""
    words = list(sys.argv[1:] if argv is None else argv)
    if "--controller" in words:
        return open_loop.main(words, __doc__)
    return main_training("gradient", GradientLearner, GradientOptions, QUICK, __doc__, words)


if __name__ == "__main__":
    with interruptible():
        main()
