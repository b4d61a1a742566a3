"""Training through the simulator against reinforcement learning (thesis Fig. 4-17).

python rl/compare.py --preset quick         # a minute
python rl/compare.py --preset coarse        # copter and coarse swimmers
python rl/compare.py --preset thesis_short  # 7,020 and 10,017 degrees of freedom: hours
python rl/compare.py --preset recipe        # swimmers by their recipe, against tuned rivals
python rl/compare.py --preset thesis_recipe # the same at the thesis's size
python rl/compare.py --preset copter_recipe # copters by theirs
python rl/compare.py --preset thesis        # the same, twenty times the budget: days
python rl/compare.py --preset coarse --tasks CopterHover --methods gradient ppo --seeds 0 1

Interrupt it at will: finished runs are not repeated, others continue. ``--executor processes:4``
trains four runs at a time, ``--executor dask:ADDRESS`` as many as a cluster has workers.
``--report`` only sums up what is there, and so makes the documentation's figures again from the
records of their runs:

python rl/compare.py --preset coarse --report --out rl/results --images docs/images
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from diffsim.cli.arguments import add_executor
from diffsim.core import open_executor
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.learn import METHODS
from rl import comparison
from rl.figures import comparison_figure
from rl.presets import PRESETS, preset
from rl.trainings import Plan


def report(task: str, plan: Plan, folder: Path, figure: Path, *, quality: bool) -> str | None:
    """Figure and tables of one task; None where no training by gradient has ended yet."""
    runs = comparison.collect(plan, folder)
    if "gradient" not in runs:
        return None
    comparison.keep_record(runs, folder)
    scale = comparison.scale_of(plan, folder, runs)
    summary = comparison.summarize(runs, scale)
    write_json_atomic(folder / "summary.json", {"task": task, "methods": summary})
    comparison_figure(figure, task, runs, scale)
    tables = [comparison.table(task, summary)]
    if quality:
        tables.append(comparison.quality_table(task, comparison.quality_of(plan, folder)))
    return "\n\n".join(tables) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    """Run; see the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--preset", choices=sorted(PRESETS), default="quick")
    add("--tasks", nargs="+", default=None, help="of the preset (all)")
    add("--methods", nargs="+", choices=METHODS, default=METHODS)
    add("--seeds", nargs="+", type=int, default=None, help="(the preset's)")
    add("--out", type=Path, default=Path("runs/compare"), help="folder (runs/compare)")
    add("--images", type=Path, default=None, help="folder of figures (that of results)")
    add("--report", action="store_true", help="do not train")
    add("--no-quality", action="store_true", help="do not compare gradients")
    add("--threads", type=int, default=1, help="of torch (1)")
    add_executor(parser, "runs")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    for task, plan in preset(args.preset).items():
        if args.tasks is not None and task not in args.tasks:
            continue
        folder = args.out / args.preset / task
        if not args.report:
            asked = {"methods": args.methods, "seeds": args.seeds}
            with open_executor(args.executor) as executor:
                comparison.run_all(plan, folder, executor=executor, **asked)
        kind = "_recipe" if args.preset.endswith("recipe") else ""
        size = "_thesis_size" if args.preset.startswith("thesis") else ""
        figure = (args.images or folder) / f"learning_{task}{kind}{size}.png"
        text = report(task, plan, folder, figure, quality=not args.no_quality)
        if text is not None:
            write_text_atomic(folder / "report.md", text)
            print(text)


if __name__ == "__main__":
    with interruptible():
        main()
