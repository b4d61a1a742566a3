"""``python -m studies.nano_drone_estimator``: why positions and velocities disagree.

How far the drone went in 0.3 s, by its positions and by its velocities along the ground, is
compared where no samples were lost. Rivals: velocity as it is; a plain scale; an estimator that
knows no drag (``diffsim.systems.multicopter.estimator``), without and with its heading. Each is
fitted to flights of some kinds and judged on all; a clock between the two is fitted away in every
flight. The test flight is judged last, nothing is fitted to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.nano_drone import DT, whole_flights
from diffsim.core import interruptible
from diffsim.systems.multicopter.estimator import BlindEstimator, force_of
from diffsim.systems.registry import setup_of

Array = NDArray[np.float64]

AHEAD, EVERY, FIRST = 30, 10, 200  # samples
LOST = 0.02  # [s]: a position that jumps by more at its speed (0.4 m/s at least) lost samples
KINDS: Mapping[str, tuple[str, ...]] = {
    "square": ("square_1", "square_3", "square_5"),
    "random1": ("random1_1", "random1_3"),
    "random2": ("random2_1", "random2_3"),
    "multisine": ("multisine_3",),
}
FITTED = (("multisine",), ("random1", "random2"), ("random1", "random2", "multisine"))
STARTS = {"none": (), "scale": (0.09,), "swing": (0.45, 4.0, 0.05), "heading": (0.45, 4, 0.05, 0.1)}
HEAD = "| velocity | fitted to | sizes | " + " | ".join((*KINDS, "melon")) + " |"


@dataclass(frozen=True, eq=False)
class Way:
    """A flight along the ground.

    Attributes:
        position, velocity: (num_samples, 2).
        states, acceleration, force: As ``BlindEstimator.of`` takes them.
        starts: Samples from which nothing is lost for ``AHEAD`` samples.
    """

    position: Array
    velocity: Array
    states: torch.Tensor
    acceleration: torch.Tensor
    force: torch.Tensor
    starts: NDArray[np.int64]

    def error(self, kind: str, sizes: Sequence[float]) -> Array:
        """What velocity is too large by, (num_samples, 2) [m/s]."""
        if kind in ("none", "scale"):
            return (sizes[0] if len(sizes) else 0.0) * self.velocity
        drag, *gains = (*sizes, 0.0)[:4]
        known = torch.tensor([drag]).double(), torch.tensor([gains]).double()
        blind = BlindEstimator.of(self.states, self.acceleration, self.force, DT, known)
        return blind.errors[0, :, 0, :2].numpy()

    def left(self, kind: str, sizes: Sequence[float]) -> Array:
        """Ways less those by velocity, a clock fitted away, (num_starts, 2) [m]."""
        true = self.velocity - self.error(kind, sizes)
        way = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * DT * (true[1:] + true[:-1]), 0)])
        ends = self.starts + AHEAD
        off = self.position[ends] - self.position[self.starts] - way[ends] + way[self.starts]
        change = self.velocity[ends] - self.velocity[self.starts]
        late = ((off * change).sum(0) / (change**2).sum(0)).clip(-0.03, 0.03)
        return off - late * change


@lru_cache
def way_of(name: str) -> Way:
    """A whole flight, in the model's frame."""
    study = whole_flights((name,))
    model = setup_of(study).model
    run = study.runs[0]
    scene = model.scene(run, model.at_prior())
    windows = scene.windows  # type: ignore[attr-defined]
    position = windows.states[:, :2].numpy()
    velocity = windows.states[:, 6:8].numpy()
    step = np.diff(position, axis=0) - 0.46 * DT * (velocity[1:] + velocity[:-1])
    speed = np.linalg.norm(windows.states[1:, 6:9].numpy(), axis=1).clip(0.4)
    lost = np.concatenate([[0], np.cumsum(np.abs(step).max(1) > LOST * speed)])
    starts = np.arange(FIRST, len(position) - AHEAD - 1, EVERY)
    starts = starts[lost[starts + AHEAD] == lost[starts]]
    push = scene.commands.sum(-1) / scene.vehicle.mass[:, None]  # type: ignore[attr-defined]
    force = force_of(windows.states, push.detach())
    return Way(position, velocity, windows.states, windows.acceleration, force, starts)


def fitted(kind: str, kinds: Sequence[str]) -> Array:
    """Sizes that explain flights of some kinds best."""
    ways = [way_of(name) for k in kinds for name in KINDS[k]]

    def left(sizes: Array) -> Array:
        return np.concatenate([w.left(kind, sizes).ravel() for w in ways])

    start = np.array(STARTS[kind])
    found = least_squares(
        left, start, x_scale=start, loss="soft_l1", f_scale=0.01, diff_step=0.01, max_nfev=8
    )
    return np.asarray(found.x)


def main() -> None:
    """Print the table: root mean squares of what is left [mm]."""
    print(HEAD + "\n" + "|---" * (HEAD.count("|") - 1) + "|")
    for kind in STARTS:
        for kinds in FITTED if STARTS[kind] else [()]:
            if kind == "heading" and kinds == ("multisine",):
                continue  # straight lines say nothing of the heading
            sizes = fitted(kind, kinds) if kinds else np.array([])
            _row(lambda w, k=kind, s=sizes: w.left(k, s), kind, kinds, sizes)
    for kinds in (("square",), ("random1", "random2"), ("multisine",)):
        share = swing_share(kinds, sizes.tolist())
        print(f"Errors over those that a state alone suggests, {', '.join(kinds)}: {share:.2f}")


def swing_share(kinds: Sequence[str], sizes: Sequence[float]) -> float:
    """Errors of the estimator over those that a state alone suggests, by least squares.

    Args:
        kinds: Kinds of flights, together.
        sizes: Drag and gains of the estimator.
    """
    known, over, square = torch.tensor([sizes]).double(), 0.0, 0.0
    for way in (way_of(name) for kind in kinds for name in KINDS[kind]):
        record = way.states, way.acceleration, way.force
        blind = BlindEstimator.of(*record, DT, (known[:, 0], known[:, 1:]))
        there = blind.errors[0, FIRST:, 0]
        alone = blind.by_state_alone(way.states, way.force).errors[0, FIRST:, 0]
        over, square = over + float((there * alone).sum()), square + float((alone**2).sum())
    return over / square


def _row(
    left: Callable[[Way], Array], kind: str, kinds: Sequence[str], sizes: Sequence[float] | Array
) -> None:
    cells = []
    for names in (*KINDS.values(), ("melon_a",)):
        off = np.concatenate([left(way_of(name)).ravel() for name in names])
        cells.append(f"{1e3 * np.sqrt((off**2).mean()):.1f}")
    shown = ", ".join(f"{s:.3g}" for s in sizes) or "-"
    print(
        f"| {kind} | {', '.join(kinds) or '-'} | {shown} | " + " | ".join(cells) + " |", flush=True
    )


if __name__ == "__main__":
    with interruptible():
        main()
