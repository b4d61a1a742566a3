"""What a case holds, from master seed, kind and round alone: machine, law, runs, and its size.

The size follows from a wanted visibility lambda: the misfit of the plain machine to the runs to
fit, its numbers fitted within their data sheet, in noise standard deviations.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labs.unlisted.catalog import FAR_SHEET, KINDS, Kind
from labs.unlisted.courses import COLUMNS, drawn_column, drawn_commands, drawn_uses
from labs.unlisted.machine import Courses, Law, Machine, simulate, with_extents
from labs.unlisted.rigs import drawn_machine, drawn_numbers

Array = NDArray[np.float64]
LAMBDAS = (20.0, 60.0)  # of the wanted visibility, drawn log-uniformly
CLOSE = 0.1  # of the visibility, at which a size is good enough
TRIES = 12  # of a size
CHORDS = 3  # steps of the plain machine's fit, along one set of tangents
COARSE = 4  # substeps of the search for a size


@dataclass(frozen=True)
class Case:
    """A case before its size is known."""

    # name, kind: of the case
    name: str
    kind: Kind
    # machine, numbers: with its data sheet, and its true numbers
    machine: Machine
    numbers: Mapping[str, float]
    law: Law | None  # what is hidden; none: nothing
    uses: tuple[str, ...]  # of the runs
    courses: Courses  # what happens in them, decoy columns among it
    repeats: bool  # whether the fifth run executes the first one's commands again
    wanted: float  # visibility
    noise: int  # seed of noise and dirt


def drawn(master: int, kind: str, turn: int) -> Case:
    """Draw a case.

    Args:
        master: Master seed.
        kind: Of ``KINDS``.
        turn: Number of the case among those of its kind.
    """
    key = (zlib.crc32(kind.encode()), turn)
    rng = np.random.default_rng(np.random.SeedSequence(master, spawn_key=key))
    of_kind = KINDS[kind]
    first = int(rng.integers(len(of_kind.machines)))
    name = of_kind.machines[(first + turn) % len(of_kind.machines)]
    machine = drawn_machine(rng, name)
    numbers = drawn_numbers(rng, machine)
    if of_kind.dirt == FAR_SHEET:
        numbers = {
            n: s.value * float(np.exp(0.01 * s.percent * rng.choice([-1.0, 1.0])))
            for n, s in machine.numbers.items()
        }
    uses, repeats = drawn_uses(rng), bool(rng.random() < 0.5)
    commands = drawn_commands(rng, machine, len(uses), repeats)
    machine = with_extents(machine, numbers, Courses(commands, {}))
    law = of_kind.law(rng, machine) if of_kind.law else None
    needed = law.columns if law else ()
    decoy = str(rng.choice([c for c in COLUMNS if c not in needed]))
    columns = {n: drawn_column(rng, n, machine, len(uses)) for n in (*needed, decoy)}
    wanted = float(np.exp(rng.uniform(*np.log(LAMBDAS))))
    noise = int(rng.integers(2**31))
    return Case(
        f"{kind}_{turn}", of_kind, machine, numbers, law, tuple(uses), Courses(commands, columns),
        repeats, wanted, noise,
    )  # fmt: skip


@dataclass(frozen=True)
class Misfit:
    """What the plain machine leaves of a law."""

    strength: float  # lambda over the runs to fit
    # of the unseen runs by channel, in SI units: what a diagnosis can gain
    rms: Mapping[str, float]


class Visibility:
    """Misfits of a case by size; tangents of its plain machine are computed once."""

    def __init__(self, case: Case):
        self.case = case
        self.sd = np.array([d.sd for d in case.machine.dials.values()])[:, None, None]
        self.fit = np.array([use == "fit" for use in case.uses])
        self.test = np.array([use == "test" for use in case.uses])
        self.free = [n for n, s in case.machine.numbers.items() if s.percent]
        self.plain, self.tangents = self._tangents()

    def _tangents(self) -> tuple[Array, Array]:
        """Readings in noise sd, and their change by one sd of each number's sheet."""
        case, num = self.case, len(self.free)
        runs = len(case.uses)
        share = 0.02  # of a prior sd
        many = {n: np.full(runs * (num + 1), v) for n, v in case.numbers.items()}
        for k, name in enumerate(self.free):
            step = np.exp(share * 0.01 * case.machine.numbers[name].percent)
            many[name][runs * (k + 1) : runs * (k + 2)] *= step
        tiled = Courses(
            {n: np.tile(c, (num + 1, 1)) for n, c in case.courses.commands.items()},
            {n: np.tile(c, (num + 1, 1)) for n, c in case.courses.columns.items()},
        )
        seen = simulate(case.machine, many, tiled, substeps=COARSE) / self.sd
        blocks = seen.reshape(len(self.sd), num + 1, runs, -1)
        return blocks[:, 0], (blocks[:, 1:] - blocks[:, :1]) / share

    def at(self, size: float) -> Misfit:
        """What the plain machine leaves at a size, its numbers fitted within their priors."""
        case, num = self.case, len(self.free)
        hidden = simulate(case.machine, case.numbers, case.courses, case.law, size, COARSE)
        jac = self.tangents[:, :, self.fit].swapaxes(0, 1).reshape(num, -1).T
        rows = np.vstack([jac, np.eye(num)])
        moved = np.zeros(num)
        for _ in range(CHORDS):
            left = hidden / self.sd - self._plain(moved)
            wanted = np.concatenate([left[:, self.fit].ravel(), -moved])
            step, *_ = np.linalg.lstsq(rows, wanted, rcond=None)
            moved = moved + step
        left = hidden / self.sd - self._plain(moved)
        strength = float(np.sqrt(np.sum(left[:, self.fit] ** 2) + np.sum(moved**2)))
        rms = np.sqrt(np.mean((left * self.sd)[:, self.test] ** 2, axis=(1, 2)))
        return Misfit(strength, dict(zip(case.machine.dials, rms.tolist(), strict=True)))

    def _plain(self, moved: Array) -> Array:
        """Readings in noise sd of the plain machine, its numbers moved by so many prior sd."""
        case = self.case
        if not np.any(moved):
            return self.plain
        sheet = case.machine.numbers
        numbers = dict(case.numbers)
        for name, by in zip(self.free, moved, strict=True):
            numbers[name] *= float(np.exp(0.01 * sheet[name].percent * np.clip(by, -5.0, 5.0)))
        return simulate(case.machine, numbers, case.courses, substeps=COARSE) / self.sd


def sized(case: Case) -> tuple[float, Misfit]:
    """The size of a case's law that is as visible as wanted, or its greatest, and its misfit.

    Args:
        case: Of the law; without one the size is 0.
    """
    law = case.law
    if law is None:
        return 0.0, Misfit(0.0, dict.fromkeys(case.machine.dials, 0.0))
    look = Visibility(case)
    size = min(law.typical, law.most)
    found, slope = look.at(size), 1.0  # lambda grows with this power of the size
    low, high = 0.0, np.inf  # sizes that are too small and too large
    for _ in range(TRIES):
        ratio = case.wanted / max(found.strength, 1e-9)
        if abs(np.log(ratio)) < CLOSE or (size >= law.most and ratio > 1.0):
            break
        low, high = (max(low, size), high) if ratio > 1.0 else (low, min(high, size))
        wanted = min(size * float(np.clip(ratio ** (1.0 / slope), 0.05, 20.0)), law.most)
        if not low < wanted < high:
            wanted = float(np.sqrt(low * high)) if low else 0.5 * high
        after = look.at(wanted)
        grown = np.log(max(after.strength, 1e-9) / max(found.strength, 1e-9))
        slope = float(np.clip(grown / np.log(wanted / size), 0.5, 3.0))
        size, found = wanted, after
    return size, found
