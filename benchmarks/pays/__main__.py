"""``python -m benchmarks.pays RIG [RIG ...]``: what a diagnosis buys on rigs of another simulator.

For each seed a rig is recorded and diagnosed; commands are found with the plain model, domain
randomization, a learned residual, the extended model, its posterior, and on the rig itself, and
executed on the rig. Writes a table, a picture and a film; what is done is kept, and a second call
goes on.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.pays.film import film
from benchmarks.pays.rigs import RIGS
from benchmarks.pays.trial import METHODS, Trial, run
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.core.threads import one_thread

Array = NDArray[np.float64]
Row = Mapping[str, Any]
SEEDS = 3
KEPT = 1.0  # CPU seconds: below them an answer was there and only read
DRAWS, LEVEL = 4000, 90.0  # of the bootstrap over seeds; of its intervals [%]


def scores(rows: Sequence[Row], method: str) -> Array:
    """Misses on the rig, (num_seeds,)."""
    return np.array([row["scores"][method] for row in rows])


def interval(values: Array) -> tuple[float, float, float]:
    """Mean of a number per seed, and the 90 % interval of a bootstrap over seeds."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(0, len(values), (DRAWS, len(values)))].mean(1)
    low, high = np.percentile(means, [50.0 - LEVEL / 2, 50.0 + LEVEL / 2])
    return float(values.mean()), float(low), float(high)


def closed(rows: Sequence[Row], method: str) -> tuple[float, float, float]:
    """Share of the gap between plain model and truth that a method closes, with its interval.

    Mean misses of all seeds, not the mean of shares: a seed with no gap has no share.
    """
    plain, truth, mine = (scores(rows, m) for m in ("plain", "truth", method))
    rng = np.random.default_rng(0)
    picks = rng.integers(0, len(rows), (DRAWS, len(rows)))

    def share(pick: Array) -> Array:
        gap = plain[pick].mean(-1) - truth[pick].mean(-1)
        return np.asarray((plain[pick].mean(-1) - mine[pick].mean(-1)) / gap)

    low, high = np.percentile(share(picks), [50.0 - LEVEL / 2, 50.0 + LEVEL / 2])
    return float(share(np.arange(len(rows)))), float(low), float(high)


def table(by_rig: Mapping[str, Sequence[Row]]) -> str:
    """Mean misses by method, shares of the gap, and paired differences, in Markdown."""
    lines = [
        f"| rig | seeds | {' | '.join(METHODS)} | extended closes | posterior closes |",
        "|---" * (len(METHODS) + 4) + "|",
    ]
    for rig, rows in by_rig.items():
        means = " | ".join(f"{scores(rows, m).mean():.3g}" for m in METHODS)
        found = (closed(rows, m) for m in ("extended", "posterior"))
        shares = " | ".join(_percent(*share, spread=len(rows) > 1) for share in found)
        lines.append(f"| {rig} | {len(rows)} | {means} | {shares} |")
    lines += ["", "| rig | miss less by | plain | randomized | residual |", "|---|---|---|---|---|"]
    for rig, rows in by_rig.items():
        for mine in ("extended", "posterior"):
            gains = (
                interval(scores(rows, m) - scores(rows, mine))
                for m in ("plain", "randomized", "residual")
            )
            cells = " | ".join(
                f"{m:.2f}" + (f" ({a:.2f} to {b:.2f})" if len(rows) > 1 else "")
                for m, a, b in gains
            )
            lines.append(f"| {rig} | {mine} | {cells} |")
    lines += ["", "| rig | seed | verdict | named | CPU s: diagnosis | all |", "|---" * 6 + "|"]
    for rig, rows in by_rig.items():
        for row in rows:
            named = ", ".join(row["named"])
            cpu = row["cpu_s"]
            explained = f"{cpu['diagnose']:.0f}" if cpu["diagnose"] > KEPT else "kept"
            lines.append(
                f"| {rig} | {row['seed']} | {row['verdict']} | {named} | {explained} | "
                f"{sum(cpu.values()):.0f} |"
            )
    return "\n".join(lines)


def _percent(share: float, low: float, high: float, *, spread: bool) -> str:
    """Without an interval where there is one seed only."""
    return f"{100 * share:.0f} %" + (f" ({100 * low:.0f} to {100 * high:.0f})" if spread else "")


def draw(row: Row, out: Path) -> Path:
    """What the rig does with three of the commands, of one seed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    trial = Trial.made(row["rig"], row["seed"], out)
    task, study = trial.task, trial.study
    t, wanted = task.given.time_s, list(task.given.wanted)
    figure, axes = plt.subplots(1, len(wanted), figsize=(4.2 * len(wanted), 3.0), squeeze=False)
    names = [c.name for c in study.channels]
    for axis, name in zip(axes[0], wanted, strict=True):
        at = names.index(name)
        since = t >= task.given.wanted[name].since
        axis.plot(t[since], task.courses[since, at], color="0.6", lw=4, label="wanted")
        for method, color in (("plain", "C3"), ("residual", "C1"), ("extended", "C0")):
            seen = trial.execute(np.array(row["knots"][method]))[:, at]
            axis.plot(t, seen, color=color, lw=1.2, label=method)
        axis.set_xlabel("time [s]")
        axis.set_ylabel(f"{name} [{study.channels[at].unit}]")
    axes[0, 0].legend(fontsize=8, frameon=False)
    figure.tight_layout()
    path = out / f"{row['rig']}.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


@one_thread
def main(argv: Sequence[str] | None = None) -> int:
    """Run the trials that are not there yet, then write the table.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pays", description=__doc__)
    parser.add_argument("rigs", nargs="+", choices=list(RIGS), metavar="RIG", help=", ".join(RIGS))
    parser.add_argument("--seeds", type=int, default=SEEDS, help="default: %(default)s")
    parser.add_argument("--first-seed", type=int, default=2, help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("runs/pays"), help="default: %(default)s")
    args = parser.parse_args(argv)
    by_rig: dict[str, list[Row]] = {}
    for rig in args.rigs:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            kept = args.out / f"{rig}_{seed}.json"
            if not kept.is_file():
                write_json_atomic(kept, run(rig, seed, args.out))
            row = json.loads(kept.read_text(encoding="utf-8"))
            by_rig.setdefault(rig, []).append(row)
            said = ", ".join(f"{m} {row['scores'][m]:.3g}" for m in METHODS)
            print(f"{rig} {seed}: {row['headline']}\n  {said}", flush=True)
        for picture in (draw, film):
            print(f"wrote {picture(by_rig[rig][0], args.out)}")
    text = table(by_rig)
    print("\n" + text)
    print(f"wrote {write_text_atomic(args.out / 'table.md', text + chr(10))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
