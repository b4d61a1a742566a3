"""``diffsim diagnose command|worth STUDY --task FILE``: what a diagnosed model is used for."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from diffsim.cli.arguments import DIAGNOSES
from diffsim.cli.diagnose_files import is_drawn
from diffsim.cli.diagnose_inputs import read_study
from diffsim.core.files import csv_text, write_json_atomic, write_text_atomic

if TYPE_CHECKING:
    from diffsim.sim_to_real.tracking import TrackingTask
    from diffsim.systems.twin import Twin

UNSETTLED = ("ambiguous", "unknown", "unrepeatable")  # verdicts that leave a cause open
COMMAND_FILE, WORTH_FILE, WORTH_PAGE = "command.csv", "worth.json", "worth.html"


def command(args: argparse.Namespace) -> None:
    """Write the commands with which the diagnosed model follows a task's courses best."""
    from diffsim.sim_to_real.tracking import best_command

    twin, task, out = _read_inputs(args)
    best = best_command(twin, task)
    if args.draws:
        drawn = twin.draw(args.draws, np.random.default_rng(args.seed))
        best = best_command(twin, task, at=drawn, starts=[best.knots])
    with torch.no_grad():
        commands = task.commands(torch.from_numpy(best.knots))
        seen = twin.simulate(commands)
    names = ["time_s", *commands, *(f"{c} predicted" for c in twin.channels)]
    columns = [task.given.time_s, *commands.values(), *seen.unbind(-1)]
    rows = (map(float, row) for row in zip(*columns, strict=True))
    print(f"expected miss: {best.score:.3g} (root mean square, in units of `miss`)")
    print(f"wrote {write_text_atomic(out / COMMAND_FILE, csv_text(names, rows, '.9g'))}")


def worth(args: argparse.Namespace) -> None:
    """Say what it would buy to mend each cause."""
    from diffsim.sim_to_real.worth import worth as worth_of

    twin, task, out = _read_inputs(args)
    if not twin.causes:
        print(f"{twin.saved.path} names no cause: there is nothing to mend")
        return
    (out / WORTH_PAGE).unlink(missing_ok=True)  # of another task: not to pass for this one's
    found = worth_of(twin, task)
    for row in found:
        print(row.words)
    rows = [{**asdict(row), "bought": row.bought} for row in found]
    print(f"wrote {write_json_atomic(out / WORTH_FILE, rows)}")

    def page() -> Path:
        from diffsim.viz.report import write  # viz by entry points only
        from diffsim.viz.worth_page import worth_page

        facts = [("model", str(twin.saved.path)), ("task", str(args.task))]
        facts.append(("verdict of the diagnosis", twin.saved.verdict or "unknown"))
        return write(worth_page(found, twin.study.name, facts), out / WORTH_PAGE)

    is_drawn(page)


def _read_inputs(args: argparse.Namespace) -> tuple[Twin, TrackingTask, Path]:
    """Model planned for the task, task, folder of the results."""
    from diffsim.sim_to_real.tracking import Tracking
    from diffsim.systems.twin import Twin

    study, given = read_study(args.study), Tracking.read(args.task)
    out: Path = args.out or Path(DIAGNOSES) / study.name
    twin = Twin.read(args.saved or out, study, given.time_s, given.setup, given.start)
    if twin.saved.verdict in UNSETTLED:
        print(
            f"{twin.saved.path}: verdict {twin.saved.verdict}, so its causes may be the wrong ones "
            f"and its commands worse than the plain model's; `diffsim diagnose next {args.study}` "
            "says which run settles it"
        )
    return twin, given.for_study(study), out
