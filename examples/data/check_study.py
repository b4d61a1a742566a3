"""Are these recordings fit for a diagnosis, and what would be wrong with them?

A virtual laboratory makes a study of a soft beam under commands; it is written, read back and
checked. Then the runs that were held out are dropped: no claim about them could be tested.

Expected: no error in the first, at least one in the second. Running time: 2 s.

    python examples/data/check_study.py  # for your own: diffsim diagnose check STUDY
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import tempfile
from dataclasses import replace

from diffsim.data import Problem, check_study, load_study, save_study
from diffsim.data.labs import LABS


def main(system: str = "soft_body", seed: int = 0) -> dict[str, list[Problem]]:
    """Problems of the whole study, and of the one without held-out runs."""
    study = LABS[system]()(seed)
    with tempfile.TemporaryDirectory() as folder:
        study = load_study(save_study(study, folder))
    print(f"{study.name}: {len(study.channels)} channels, {len(study.runs)} runs")
    return {
        "as recorded": check_study(study),
        "nothing held out": check_study(replace(study, runs=study.fit_runs)),
    }


if __name__ == "__main__":
    with interruptible():
        for name, problems in main().items():
            print(f"{name}: {len(problems)} problems")
            for problem in problems:
                print(f"  {problem}")
