"""The command line that all application scripts share."""

from __future__ import annotations

from diffsim.core.script import ask_for

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim import soft
from diffsim.core.files import write_json_atomic
from diffsim.optim import LogError
from examples.applications.application import SOLVERS, Application, solver_options
from examples.applications.minimize import Outcome, minimize
from examples.applications.normalize import normalized, random_losses
from examples.applications.pictures import motion_strip, recording

Build = Callable[[soft.SolverOptions, bool], Application]
"""Application of solver options and ``quick``; the options' tolerances are the script's to set."""


def main(
    build: Build,
    doc: str,
    *,
    rtol: float = 1e-4,
    max_evaluations: int = 60,
    view: tuple[float, float] = (14.0, -65.0),
    argv: Sequence[str] | None = None,
) -> dict[str, float]:
    """Optimize an application, print and keep its numbers, draw it, record it.

    Args:
        build: Function that makes the application.
        doc: The script's docstring, for ``--help``.
        rtol: Relative tolerance of a time step's solution [-].
        max_evaluations: Largest number of evaluations of loss and gradient; ``--quick`` takes no
            more than 8. With ``--evaluations 0`` nothing is optimized: numbers and pictures are
            those of where the search begins.
        view: Elevation and azimuth of the picture [degrees].
        argv: Arguments; None: the process's.

    Returns:
        The numbers that it prints.
    """
    args = _parser(doc, max_evaluations).parse_args(argv)
    if not args.no_pictures:
        ask_for(["matplotlib", "rerun"], purpose="a picture and a recording (or --no-pictures)")
    torch.set_num_threads(args.threads)
    application = build(
        solver_options(args.solver, rtol=rtol, num_threads=args.threads), args.quick
    )
    out = args.out or Path("runs/applications") / application.name
    size = "quick" if args.quick else "full"
    limit = min(8, args.evaluations) if args.quick else args.evaluations
    begun = application.motion(application.parameters.first)
    steps = len(begun) - 1
    print(
        f"{application.name} ({application.source}): {application.body.mesh.num_elements} elements,"
        f" {application.num_dofs} DoF, {steps} steps of {1e3 * application.body.dt:g} ms"
    )
    if limit == 0:
        if not args.no_pictures:
            _draw(application, {"first guess": begun}, out, f"{size}_first", view)
        return _print_numbers(application.numbers(application.parameters.first, begun))
    kept = out / f"{args.solver}_{size}.jsonl"
    drawn = out / f"random_{size}.jsonl"
    if args.fresh:
        for record in (kept, kept.with_name(f"warm_up_{kept.name}"), drawn):
            record.unlink(missing_ok=True)
    with _refusals():
        outcome = minimize(application, max_evaluations=limit, record=kept, progress=True)
    numbers = summary(application, outcome)
    if not args.quick:
        tried = outcome.evaluations[: outcome.num_starts]
        with _refusals():
            losses = random_losses(application, record=drawn, tried=tried)
        random = float(np.mean(losses))
        numbers["random loss"] = random
        if application.oracle is not None:
            numbers["normalized loss"] = normalized(outcome.best.loss, random, application.oracle)
    _print_numbers(numbers)
    print(f"ended: {outcome.message}")
    write_json_atomic(
        out / f"result_{args.solver}_{size}.json",
        {"numbers": numbers, "message": outcome.message, "best": asdict(outcome.best)},
    )
    if not args.no_pictures:
        shown = {
            "before": begun,
            "optimized": application.motion(np.array(outcome.best.values)),
        }
        if application.oracle_parameters is not None:
            shown["target"] = application.motion(application.oracle_parameters)
        _draw(application, shown, out, size, view)
    return numbers


def _print_numbers(numbers: Mapping[str, float]) -> dict[str, float]:
    for name, value in numbers.items():
        print(f"{name:36s} {value:.6g}")
    return dict(numbers)


def _draw(
    application: Application,
    shown: Mapping[str, Tensor],
    out: Path,
    kind: str,
    view: tuple[float, float],
) -> None:
    """Strip and recording of motions, by caption."""
    print("picture:", motion_strip(application, shown, out / f"strip_{kind}.png", view=view))
    print("recording:", recording(application, shown, out / f"{application.name}_{kind}.rrd"))


def summary(application: Application, outcome: Outcome) -> dict[str, float]:
    """Losses, evaluations and times of an optimization, and what the solution means."""
    made = [e for e in outcome.evaluations[outcome.num_starts :] if not e.failure]
    best = np.array(outcome.best.values)
    numbers = {
        "evaluations": len(outcome.evaluations) - outcome.num_starts,
        "evaluations of the warm-up": outcome.num_warm_up,
        "failed evaluations": len(outcome.evaluations) - outcome.num_starts - len(made),
        "first loss": made[0].loss,
        "final loss": outcome.best.loss,
        "forward s (median)": float(np.median([e.forward_s for e in made])),
        "backward s (median)": float(np.median([e.backward_s for e in made])),
        "forward CPU s (median)": float(np.median([e.forward_cpu_s for e in made])),
        "backward CPU s (median)": float(np.median([e.backward_cpu_s for e in made])),
    }
    first = application.parameters.first
    before = application.numbers(first, application.motion(first))
    after = application.numbers(best, application.motion(best))
    for name in after:
        numbers[f"{name}, before"] = before[name]
        numbers[f"{name}, optimized"] = after[name]
    if application.oracle_parameters is not None:
        truth = application.oracle_parameters
        for name, value in application.numbers(truth, application.motion(truth)).items():
            numbers[f"{name}, truth"] = value
    return numbers


@contextmanager
def _refusals() -> Iterator[None]:
    """A record that cannot be gone on from ends the program with the reason, not a traceback."""
    try:
        yield
    except LogError as err:
        raise SystemExit(f"{err}; --fresh deletes it") from err


def _parser(doc: str, max_evaluations: int) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=doc.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a coarse mesh, few evaluations")
    parser.add_argument("--solver", choices=tuple(SOLVERS), default="projective_dynamics")
    parser.add_argument(
        "--evaluations",
        type=int,
        default=max_evaluations,
        metavar="N",
        help="0: show where the search begins",
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N")
    parser.add_argument("--out", type=Path, help="default: runs/applications/NAME")
    parser.add_argument("--fresh", action="store_true", help="forget the evaluations on record")
    parser.add_argument("--no-pictures", action="store_true")
    return parser
