"""Force stands: static readings of a law, swept up and down, with one thing wrong about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run, Study
from labs.rates.rig import Cause, Recorded, Size
from labs.rates.troubles import COLOR, LOST_ROWS, TAILS, with_noise

Array = NDArray[np.float64]
SWEEPS = 6  # to fit, and one for the test
SHARE = 0.02  # by which a reading's gain may differ from its data sheet's


@dataclass(frozen=True)
class Sweep:
    """What one sweep knows: settings, the usual and greatest one, its place in the series."""

    x: Array
    usual: float
    order: int

    @property
    def way(self) -> Array:
        """1 on the way up, -1 on the way down."""
        return np.sign(np.gradient(self.x))


def _bump(x: Array) -> Array:
    return np.asarray(np.exp(-(((x - 1.2) / 0.1) ** 2)))


#: (reading of the law [y], sweep, size) -> reading.
Change = Callable[[Array, Sweep, float], Array]
CHANGES: Mapping[str, Change] = {
    "exponent": lambda y, s, size: y * (s.x / s.usual) ** size,
    "growth": lambda y, s, size: y * (1.0 + size * ((s.x / s.usual) ** 2 - 1.0)),
    "low_end_loss": lambda y, s, size: y * (1.0 - size * (np.sqrt(s.usual / s.x) - 1.0)),
    "linear_part": lambda y, s, size: y + size * s.x,
    "zero": lambda y, s, size: y + size,
    "hysteresis": lambda y, s, size: y * (1.0 + size * s.way),
    "run_drift": lambda y, s, size: y * (1.0 + size * np.linspace(0.0, 1.0, len(y))),
    "order_drift": lambda y, s, size: y * (1.0 + size * s.order),
    # what no library holds: a resonance of the stand near one setting
    "resonance": lambda y, s, size: y * (1.0 + size * _bump(s.x / s.usual)),
}


@dataclass(frozen=True)
class ForceStand:
    """A stand that reads a force y = c x^power of what was set."""

    name: str  # of the stand
    coefficient: float  # of its data sheet
    power: int  # of the law
    # low, high: ends of a sweep
    low: float
    high: float
    noise: float  # of the reading
    units: tuple[str, str]  # of reading and setting
    setup_file: Path | None = None
    disturbances: tuple[str, ...] = (LOST_ROWS, COLOR, TAILS)

    @property
    def causes(self) -> Mapping[str, Cause]:
        """What it can hide."""
        y, x = self.coefficient * self.high**self.power, self.high
        return {
            "exponent_of_thrust": Cause(0.05, signed=True, most=1.0),
            "growth_of_thrust": Cause(0.03, signed=True, most=0.5),
            "low_end_loss_of_thrust": Cause(0.03, signed=True, most=0.5),
            "linear_part_of_thrust": Cause(0.02 * y / x, signed=True),
            "zero_of_thrust": Cause(0.01 * y, signed=True),
            "hysteresis_of_thrust": Cause(0.01, signed=True),
            "run_drift_of_thrust": Cause(0.02, signed=True),
            "order_drift_of_thrust": Cause(0.01, signed=True),
            "resonance": Cause(0.02, signed=True, known=False),
        }

    def record(self, seed: int, hidden: Mapping[str, Size], disturbance: str) -> Recorded:
        """Sweeps up and down, no two to the same end."""
        rng, noise = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
        true = self.coefficient * float(np.exp(0.1 * np.clip(rng.standard_normal(), -1.5, 1.5)))
        ends = self.high * (1.0 - 0.15 * rng.random(SWEEPS + 1))
        channels = (Channel("thrust", self.units[0], "force", self.noise),)
        settings = [self._sweep(end) for end in ends]
        usual = float(np.sqrt(np.mean(np.concatenate(settings[:SWEEPS]) ** 2)))
        runs, clean = [], []
        for order, x in enumerate(settings):
            y = true * x**self.power
            for name, size in hidden.items():
                change = CHANGES[name.removesuffix("_of_thrust")]
                y = change(y, Sweep(x, usual, order), size[0])
            use = "test" if order == SWEEPS else "fit"
            time: Array = np.arange(float(len(x)))
            run = Run(f"sweep_{order}", time, y[:, None], {"x": x}, f"sweep_{order}", order, use)
            noisy, exact = with_noise(noise, run, channels, disturbance)
            runs.append(noisy)
            clean.append(exact)
        study = Study(self.name, "bench", channels, tuple(runs), model=self._model)
        whole = Study(self.name, "bench", channels, tuple(clean), model=self._model)
        return Recorded(study, whole, {"c": true})

    def _sweep(self, end: float) -> Array:
        up = np.linspace(self.low, end, 20)
        return np.concatenate([up, up[::-1] + 0.3 * (up[1] - up[0]) * (up[::-1] < end)])

    @property
    def _model(self) -> dict[str, Any]:
        return {
            "system": "bench",
            "define": {"thrust": f"c*x**{self.power}"},
            "readings": {"thrust": "thrust"},
            "parameters": {"c": {"value": self.coefficient, "percent": 15}},
            "laws": [
                {"name": "thrust", "of": "x", "unit": self.units[0], "of_unit": self.units[1],
                 "sweeps": True},
            ],
        }  # fmt: skip


BENCH = (
    ForceStand("propeller", 1e-5, 2, 100.0, 900.0, 0.02, ("N", "rad/s")),
    ForceStand("load_cell", 4.0, 1, 1.0, 12.0, 0.1, ("N", "V")),
)
