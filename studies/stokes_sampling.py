"""Is it worth sampling designs before L-BFGS? The ablation of thesis Fig. 4-26.

python -m studies.stokes_sampling --starts 4 --evaluations 30    # three devices, 5 CPU minutes
python -m studies.stokes_sampling amplifier --resolution 0.5     # quick

Random designs are drawn as ``devices.optimize`` does, and L-BFGS runs from every one of them: the
best one is where ``optimize`` starts, the others are starts that somebody might have chosen. Every
flow is kept in ``--out``, so that the same command goes on after an interruption. Written there:
report.md with the table, results.json with every loss, sampling.png and .svg.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.plot_style import (
    Rows,
    legend_below,
    new_figure,
    number_in_steps_of_1_2_5,
    save,
    style,
)
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.optim import Log
from diffsim.stokes import devices
from diffsim.stokes.devices.optimize import search_settings
from diffsim.stokes.devices.sampling import draw
from diffsim.stokes.devices.search import descend
from diffsim.viz.figures import COLORS, INK
from labs.machine import machine

NAMES = ("amplifier", "averager", "gate")
STUCK, PERFECT = 2.0, 1e-3  # stuck: ends above STUCK times the best end, and above PERFECT


def measure(
    device: devices.Device,
    path: Path | None,
    *,
    num_samples: int,
    num_starts: int,
    seed: int,
    max_evaluations: int,
) -> dict[str, Any]:
    """L-BFGS from the best random design, which ``optimize`` takes, and from the first others.

    Returns:
        "histories": loss of every evaluation, normalized, one list per start, that of the best
        sample first; None where there was no flow. "finals": the least of each.
    """
    log = Log(path, search_settings(device, num_samples, seed))
    samples = draw(device, log, num_samples, seed, progress=True)
    unit = float(samples.losses.mean())
    best = int(samples.losses.argmin())
    order = [best, *(k for k in range(num_samples) if k != best)][:num_starts]
    descents = [
        descend(
            device,
            samples.x[k],
            log,
            f"start {k}",
            unit=unit,
            max_evaluations=max_evaluations,
        )
        for k in order
    ]
    histories = [(d.losses / unit).tolist() for d in descents]
    return {
        "device": device.name,
        "cells": list(device.grid.shape),
        "unit": unit,
        "samples": num_samples,
        "finals": [d.loss / unit for d in descents],
        "histories": [[v if np.isfinite(v) else None for v in h] for h in histories],
        "seconds": float(np.mean([d.seconds for d in descents])),
        "reference": device.reference.get("loss"),
    }


def summary(result: dict[str, Any]) -> dict[str, Any]:
    """The row of the table."""
    finals = np.array(result["finals"])
    sampled, others = finals[0], finals[1:]
    return {
        "device": result["device"],
        "first": result["histories"][0][0],
        "sampled": sampled,
        "best": others.min(),
        "median": np.median(others),
        "worst": others.max(),
        "stuck": int((others > max(STUCK * finals.min(), PERFECT)).sum()),
        "better": int((others < sampled).sum()),
        "count": len(others),
        "evaluations": sum(len(h) for h in result["histories"]),
    }


def report(results: Rows) -> str:
    """The table, in Markdown."""
    lines = [
        "# L-BFGS from the best of several random designs, and from each of the others",
        "",
        "Normalized losses: 1 is the mean of the random designs. Stuck: ends above "
        f"{STUCK:g} times the best end of all starts, and above {PERFECT:g}.",
        "",
        "| device | starts | best sample: first, final | others: best, median, worst final | "
        "others that end better | others that are stuck | flows with gradient |",
        "|---|---|---|---|---|---|---|",
    ]
    for result in results:
        s = summary(result)
        lines.append(
            f"| {s['device']} | {s['count'] + 1} | {s['first']:.2g}, **{s['sampled']:.2g}** | "
            f"{s['best']:.2g}, {s['median']:.2g}, {s['worst']:.2g} | {s['better']} of {s['count']} "
            f"| {s['stuck']} of {s['count']} | {s['evaluations']} |"
        )
    return "\n".join(lines)


def draw_figure(results: Rows, path: Path) -> None:
    """Least loss so far over evaluations, one panel per device."""
    figure = new_figure(3.6 * len(results) + 0.4, 3.7)
    panels = figure.subplots(1, len(results), squeeze=False)[0]
    for ax, result in zip(panels, results, strict=True):
        style(ax, result["device"], "evaluation of loss and gradient")
        for k, history in enumerate(result["histories"]):
            best = np.minimum.accumulate([np.inf if v is None else v for v in history])
            chosen = k == 0
            ax.plot(
                1 + np.arange(len(best)),
                best,
                color=COLORS["published"] if chosen else "#0b7f86",
                lw=2.2 if chosen else 1.0,
                alpha=1.0 if chosen else 0.6,
                zorder=3 if chosen else 2,
                label=f"from the best of {result['samples']} random designs"
                if chosen
                else "from others of them",
            )
        if result["reference"]:
            ax.axhline(result["reference"], color=INK, lw=0.8, ls="--", label="thesis, final")
        ax.set_yscale("log")
        low, high = ax.get_ylim()
        if high < 100.0 * low:  # hardly a power of ten to label
            number_in_steps_of_1_2_5(ax.yaxis)
    panels[0].set_ylabel("normalized loss, least so far", fontsize=9)
    legend_below(figure, panels, 3)
    save(figure, path)


def main(argv: Sequence[str] | None = None) -> Rows:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=list(NAMES), metavar="DEVICE")
    parser.add_argument("--resolution", type=float, default=1.0, help="factor on cells per axis")
    parser.add_argument("--samples", type=int, default=10, help="random designs per device")
    parser.add_argument("--starts", type=int, help="of them, to improve (all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=50, help="at most, per start")
    parser.add_argument("--out", type=Path, default=Path("runs/stokes_sampling"))
    args = parser.parse_args(argv)
    num_starts = args.samples if args.starts is None else args.starts
    if not 2 <= num_starts <= args.samples:
        parser.error("--starts must lie between 2 (the best and another) and --samples")
    torch.set_num_threads(1)
    results = [
        measure(
            devices.make(name, args.resolution),
            args.out / f"{name}_{args.resolution:g}_{args.seed}_{args.samples}.json",
            num_samples=args.samples,
            num_starts=num_starts,
            seed=args.seed,
            max_evaluations=args.evaluations,
        )
        for name in args.names
    ]
    write_json_atomic(args.out / "results.json", {"machine": machine(), "devices": results})
    write_text_atomic(args.out / "report.md", report(results) + "\n")
    draw_figure(results, args.out / "sampling")
    print(report(results))
    return results


if __name__ == "__main__":
    with interruptible():
        main()
