"""Which strokes are fast, and which model knows it? 63 strokes in four models and the laboratory.

Open and close in periods of 0.2 to 1.5 s, from 0, 4 or 8 mm to 18 mm, closed for 35, 50 or 65 % of
the time: speeds of the starfish in the virtual laboratory of
``examples/sim_to_real/learned_swimmer.py`` (no scatter), and in simulation: body and water as from
data sheets or as identified from a chain's recordings, the servo ideal or as diagnosed.

    python examples/sim_to_real/learned_swimmer.py --out runs/learned_swimmer
    python -m studies.swim_strokes --chains runs/learned_swimmer

Every column is kept in ``--out``. The laboratory takes three minutes of processor time, a model
20 seconds.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim import soft
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic
from diffsim.learn.tendon_swim import DATA_SHEET, DT, Servo, TendonSwim
from diffsim.sim_to_real import (
    Command,
    Limits,
    Rig,
    Truth,
    VirtualLaboratory,
    open_close,
    speed,
)

Array = NDArray[np.float64]
LIMITS = Limits(contraction_m=0.018, rate_m_s=0.3)
HIDDEN = Servo(lag_s=Rig().lag_s, rate_m_s=0.110, slack_m=0.0074)  # of the laboratory
PERIODS_S, LOWS_M = (0.2, 0.3, 0.4, 0.55, 0.75, 1.0, 1.5), (0.0, 0.004, 0.008)
CLOSED = (0.35, 0.5, 0.65)
SECONDS = 5.0
PLAIN, DIAGNOSED = "identified", "diagnosed, then identified"
GRID = tuple(itertools.product(PERIODS_S, LOWS_M, CLOSED))


def strokes() -> list[Command]:
    """The commands of ``GRID``."""

    return [open_close(period_s=t, low_m=low, closed=c, limits=LIMITS) for t, low, c in GRID]


def in_model(servo: Servo, body: Mapping[str, float], commands: list[Command]) -> list[float]:
    """Speeds of the center of mass [m/s]."""
    task = TendonSwim(servo, SECONDS, LIMITS, body)
    state = task.rest(len(commands), np.random.default_rng(0))
    now, arm = soft.State(state["x"], state["v"]), state["arm"]
    asked = torch.from_numpy(np.stack([c.during(SECONDS) for c in commands]))
    places = []
    with torch.no_grad():
        for column in asked.T:
            now, arm = task.pulled(now, arm, column[:, None])
            places.append(task.model.observe(now.x)[:, -1])
    time: Array = DT * np.arange(len(places), dtype=np.float64)
    ways = torch.stack(places).T.numpy()
    return [speed(time, way, c.period_s) for way, c in zip(ways, commands, strict=True)]


def in_laboratory(commands: list[Command]) -> list[float]:
    """Speeds of the markers, one recording each, without scatter between repeats [m/s]."""
    lab = VirtualLaboratory(
        duration_s=SECONDS,
        limits=LIMITS,
        truth=Truth(slack_m=HIDDEN.slack_m),
        rig=Rig(lag_s=HIDDEN.lag_s, rate_m_s=HIDDEN.rate_m_s or np.inf),
        scatter=0.0,
    )
    runs = [lab.execute(command, order=0) for command in commands]
    return [
        speed(run.time_s, run.measured[:, ::2], c.period_s)
        for run, c in zip(runs, commands, strict=True)
    ]


Kept = Mapping[str, Mapping[str, list[float]]]  # speeds by model and chain
Compute = Callable[[list[Command]], list[float]]


def columns(chains: Sequence[Path]) -> dict[str, dict[str, Compute]]:
    """What is computed, by name: once, or once per chain, with what that chain identified."""
    return {
        "laboratory": {"": in_laboratory},
        "data sheet": {"": partial(in_model, Servo(), DATA_SHEET)},
        "data sheet, servo as it is": {"": partial(in_model, HIDDEN, DATA_SHEET)},
        PLAIN: {c.name: partial(in_model, Servo(), identified(c, "plain")) for c in chains},
        DIAGNOSED: {
            c.name: partial(in_model, diagnosed(c), identified(c, "extended")) for c in chains
        },
    }


def diagnosed(chain: Path) -> Servo:
    """What a chain's diagnosis said of the servo."""
    known = json.loads((chain / "numbers.json").read_text(encoding="utf-8"))
    return Servo(**known["servo"])


def identified(chain: Path, name: str) -> dict[str, float]:
    """Body and water that a chain identified."""
    kept = json.loads((chain / f"{name}_identified.json").read_text(encoding="utf-8"))
    return {key: float(kept["values"][key]) for key in DATA_SHEET}


def table(kept: Kept) -> str:
    """What every model says of the strokes, means over chains, in Markdown."""
    from scipy.stats import t

    real = np.array(kept["laboratory"][""])
    lines = [
        "| model | correlation with the laboratory | error, rms | right sign | its best stroke | "
        "it promises | laboratory there |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, found in kept.items():
        said = np.array([found[chain] for chain in sorted(found)])
        best = said.argmax(1)
        alike = np.mean([np.corrcoef(row, real)[0, 1] for row in said])
        sign = np.mean(np.sign(said) == np.sign(real))
        lines.append(
            f"| {name} | {alike:.2f} | {1e2 * np.sqrt(np.mean((said - real) ** 2)):.2f} cm/s | "
            f"{sign:.0%} | {'; '.join(sorted({_named(k) for k in best}))} | "
            f"{1e2 * said.max(1).mean():.2f} cm/s | {1e2 * real[best].mean():.2f} cm/s |"
        )
    chosen = [
        np.array([real[int(np.argmax(kept[name][c]))] for c in sorted(kept[name])])
        for name in (PLAIN, DIAGNOSED)
    ]
    gain = 1e2 * (chosen[1] - chosen[0])
    if len(gain) > 1:
        half = t.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / np.sqrt(len(gain))
        lines.append(
            f"\nGain of the diagnosis by each model's best stroke: {gain.mean():.2f} cm/s, "
            f"95 % interval {gain.mean() - half:.2f} to {gain.mean() + half:.2f} over "
            f"{len(gain)} chains."
        )
    return "\n".join(lines)


def _named(k: int) -> str:
    period, low, closed = GRID[k]
    return f"{period:g} s, from {1e3 * low:g} mm, {closed:.0%} closed"


def draw(kept: Kept, path: Path) -> None:
    """Speeds in the laboratory over those that models promise; of the first chain."""

    import matplotlib.pyplot as plt

    names = [name for name in kept if name != "laboratory"]
    real = 1e2 * np.array(kept["laboratory"][""])
    figure, places = plt.subplots(
        1, len(names), figsize=(2.9 * len(names), 3.1), sharey=True, layout="constrained"
    )
    periods = np.array([g[0] for g in GRID])
    for place, name in zip(places, names, strict=True):
        said = 1e2 * np.array(min(kept[name].items())[1])
        place.plot([0, 2.3], [0, 2.3], color="#9aa5a5", lw=1)
        dots = place.scatter(said, real, c=np.log(periods), cmap="viridis", s=18)
        place.set_title(name, fontsize=10)
        place.set_xlabel("promised [cm/s]")
        place.axvline(0.0, color="#dfe6e9", zorder=0)
    places[0].set_ylabel("laboratory [cm/s]")
    bar = figure.colorbar(dots, ax=places, ticks=np.log(PERIODS_S[::2]))
    bar.set_ticklabels([f"{t:g} s" for t in PERIODS_S[::2]])
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    """Compute what is missing, print the table, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--chains", type=Path, default=Path("runs/learned_swimmer"))
    parser.add_argument("--out", type=Path, default=Path("runs/swim_strokes"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    path = args.out / "speeds.json"
    kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    chains = sorted(numbers.parent for numbers in args.chains.glob("seed_*/numbers.json"))
    for name, computed in columns(chains).items():
        for chain, compute in computed.items():
            if chain not in kept.setdefault(name, {}):
                kept[name][chain] = compute(strokes())
                write_json_atomic(path, kept)
    print(table(kept))
    draw(kept, args.out / "swim_strokes.png")


if __name__ == "__main__":
    with interruptible():
        main()
