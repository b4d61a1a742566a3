"""``python -m benchmarks.diagnose_published``: every published data set by its YAML alone.

One row per data set: verdict, first sentence of the page, CPU seconds of the whole answer, the
machine being whatever it is. ``--only A,B`` and ``--out FILE.md``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from diffsim.cli.diagnose_check import require_ready
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_text_atomic
from diffsim.diagnose import diagnose

PUBLISHED = Path(__file__).parents[1] / "diffsim/systems/published"
NAMES = tuple(sorted(path.stem for path in PUBLISHED.glob("*.yaml")))
HEAD = "| data set | verdict | first sentence | certain | CPU s |\n|---|---|---|---|---|"


def row(name: str) -> str:
    """One data set, from its YAML to the first sentence of its page.

    Args:
        name: Name of a published data set.
    """
    start = time.process_time()
    try:
        study = read_study(name)
        require_ready(study, name)
        inputs = inputs_of(study, seed=0)
        setup = inputs.setup
        report = diagnose(
            inputs.study,
            setup.model,
            setup.effects,
            seed=inputs.seed,
            unknowns=setup.unknowns,
            settings=setup.settings,
        )
    except (DiffsimError, ValueError) as error:
        cpu = time.process_time() - start
        return f"| {name} | failed | {' '.join(str(error).split())} | – | {cpu:.0f} |"
    cpu = time.process_time() - start
    certain = ", ".join(c.name for c in report.causes if c.status == "certain") or "–"
    return f"| {name} | {report.verdict} | {report.headline} | {certain} | {cpu:.0f} |"


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=",".join(NAMES), help="names, comma between them")
    parser.add_argument("--out", type=Path, help="Markdown file that gets the table, too")
    args = parser.parse_args()
    lines = [HEAD]
    print(HEAD)
    for name in args.only.split(","):
        lines.append(row(name))
        print(lines[-1], flush=True)
        if args.out is not None:
            write_text_atomic(args.out, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
