"""Steps that the virtual laboratories share: effects by name, noise, decoys, making of a study.

Shares no code with the simulators, nor with the effects of the diagnosis.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import require_choice
from diffsim.data.study import Channel, Run, Study

Array = NDArray[np.float64]
Sizes = Mapping[str, float | Sequence[float] | None]

DECOYS = {
    "heavy_tails": "noise of Student's t with three degrees of freedom, of equal sd",
    "spikes": "one sample in a hundred is off by 5 to 15 sd",
    "colored_noise": "noise with autocorrelation 0.7 from sample to sample",
    "far_prior": "base parameters three prior sd off",
    "lost_repeat": "one repeat of the first command is missing",
    "gaps": "one sample in twenty was not recorded",
    "scatter": "repeats differ by a gain jitter of 10 %: not a function of the command",
}
NOISE_COLOR = 0.3
GAIN_JITTER = 0.005
SCATTER_GAIN = 0.10


@dataclass(frozen=True)
class LabEffect:
    """A cause that a laboratory can hide in its data."""

    unit: str  # SI unit of every component, "-" if none
    typical: float  # a size that would be no surprise
    form: str  # what the effect does at a given size, in a line
    components: int = 1  # number of amplitudes that the effect has
    outside: bool = False  # it is in no library of candidates; the right verdict is ``unknown``


@dataclass(frozen=True)
class Base:
    """A base parameter: what the experimenter believes, and how sure he is (relative)."""

    value: float
    relative_sd: float
    unit: str


@dataclass(frozen=True)
class Plan:
    """One run to be made: its command at ``time_s``, and facts of its set-up."""

    name: str
    group: str
    use: str
    time_s: Array
    command: dict[str, Array]
    setup: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LabCase:
    """A study with the truth behind it, which a diagnosis must not see."""

    study: Study
    truth: dict[str, Any]


class Lab(ABC):
    """A virtual laboratory; ``case`` makes a study with the effects that it is given to hide.

    Class attributes:
        system: Recorded system, in a word.
        channels: What it measures; ``sd`` is that of the noise it adds.
        effects: What it can hide, by name.
        base: Base parameters; the truth is drawn from their priors.
    """

    system: ClassVar[str]
    channels: ClassVar[tuple[Channel, ...]]
    effects: ClassVar[Mapping[str, LabEffect]]
    base: ClassVar[Mapping[str, Base]]

    @abstractmethod
    def plans(self, rng: np.random.Generator) -> list[Plan]:
        """Runs in their order: several commands, repeats, one held-out command."""

    @abstractmethod
    def measure(self, plan: Plan, truth: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        """Noise-free channels, (num_samples, num_channels), and the command as recorded."""

    @abstractmethod
    def nuisances(self, rng: np.random.Generator) -> dict[str, Any]:
        """Placement errors of this study."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Geometry and settings that a model needs."""

    def __call__(
        self, seed: int, effect: str | None = None, size: float | Sequence[float] | None = None
    ) -> Study:
        """A study with at most one effect; ``size`` None is its typical size."""
        return self.case(seed, {} if effect is None else {effect: size}).study

    def case(
        self,
        seed: int,
        effects: Sizes | None = None,
        decoys: Sequence[str] = (),
        *,
        noise: float = 1.0,
    ) -> LabCase:
        """A study with hidden effects.

        Args:
            seed: Seed of base parameters, placements, gains and noise. Studies of one seed with
                other effects differ by the effects only.
            effects: Sizes by name, in the effect's unit; a scalar is the first component, None
                the typical size.
            decoys: Names of disturbances that are no effect, keys of ``DECOYS``.
            noise: Factor on the noise; 0 gives what sensors without noise would have read.

        Raises:
            ValueError: unknown effect or decoy, or a wrong number of components.
        """
        sizes = {name: self._components(name, size) for name, size in (effects or {}).items()}
        for name in decoys:
            require_choice("decoys", name, DECOYS)
        places, gains, drawn = (
            np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)
        )
        reach = 3.0 if "far_prior" in decoys else None
        truth: dict[str, Any] = {
            "base": {name: _draw(base, places, reach) for name, base in self.base.items()},
            "nuisances": self.nuisances(places),
            "effects": sizes,
            "decoys": list(decoys),
        }
        jitter = SCATTER_GAIN if "scatter" in decoys else GAIN_JITTER
        runs = []
        for order, plan in enumerate(self.plans(places)):
            gain = 1.0 + jitter * float(gains.standard_normal())
            hidden = truth | {"gain": gain, "order": order, "seed": int(gains.integers(2**31))}
            clean, command = self.measure(plan, hidden)
            measured = clean + noise * self._noise(drawn, len(clean), decoys)
            runs.append(
                Run(
                    plan.name,
                    plan.time_s,
                    measured,
                    command,
                    plan.group,
                    order,
                    plan.use,
                    plan.setup,
                )
            )
        if "lost_repeat" in decoys:
            runs.remove(next(r for r in runs[1:] if r.group == runs[0].group))
            runs = [replace(run, order=order) for order, run in enumerate(runs)]
        return LabCase(self._study(seed, runs), truth)

    def _components(self, name: str, size: float | Sequence[float] | None) -> tuple[float, ...]:
        effect = self.effects[require_choice("effects", name, self.effects)]
        if size is None:
            size = effect.typical
        given = (float(size),) if isinstance(size, (int, float)) else tuple(map(float, size))
        if len(given) not in (1, effect.components):
            raise ValueError(
                f"effect {name} has {effect.components} components, got {len(given)} sizes"
            )
        return given + (0.0,) * (effect.components - len(given))

    def _noise(self, rng: np.random.Generator, n: int, decoys: Sequence[str]) -> Array:
        from scipy.signal import lfilter

        color = 0.7 if "colored_noise" in decoys else NOISE_COLOR
        columns = []
        for channel in self.channels:
            sd = channel.sd or 0.0
            drive = rng.standard_normal(n + 50)
            if "heavy_tails" in decoys:
                drive = rng.standard_t(3, n + 50) / np.sqrt(3.0)
            column = sd * np.sqrt(1.0 - color**2) * lfilter([1.0], [1.0, -color], drive)[50:]
            if "spikes" in decoys:
                hit = rng.random(n) < 0.01
                column = column + hit * sd * rng.uniform(5.0, 15.0, n) * rng.choice([-1.0, 1.0], n)
            if "gaps" in decoys:
                column = np.where(rng.random(n) < 0.05, np.nan, column)
            columns.append(column)
        return np.column_stack(columns)

    def _study(self, seed: int, runs: list[Run]) -> Study:
        base = {
            name: {"value": b.value, "relative_sd": b.relative_sd, "unit": b.unit}
            for name, b in self.base.items()
        }
        return Study(
            name=f"virtual_{self.system}_{seed}",
            system=self.system,
            channels=self.channels,
            runs=tuple(runs),
            metadata={
                "virtual": True,
                "title": f"VIRTUAL {self.system}: computed by labs.virtual, not measured",
                "base_priors": base,
                "gain_jitter": GAIN_JITTER,
                **self.facts(),
            },
        )


def _draw(base: Base, rng: np.random.Generator, reach: float | None) -> float:
    z = float(rng.standard_normal())
    z = z if reach is None else float(np.copysign(reach, z))
    return base.value * float(np.exp(base.relative_sd * z))


def size_of(truth: Mapping[str, Any], name: str) -> float:
    """Size of an effect with one component; zero where it is not hidden."""
    return float(truth["effects"].get(name, (0.0,))[0])


def vector_of(truth: Mapping[str, Any], name: str, components: int) -> Array:
    """Size of an effect with several components."""
    return np.array(truth["effects"].get(name, (0.0,) * components))


def delayed(time_s: Array, command: Array, delay: float, lag: float, step: float) -> Array:
    """A command, piecewise linear in time, after a dead time and a first-order lag.

    The lag is solved exactly for a ramp on every ``step``.

    Args:
        time_s: Times of the command and of the result, evenly spaced by ``step``.
    """
    late = np.interp(time_s - delay, time_s, command)
    if lag <= 0.0:
        return late
    decay = np.exp(-step / lag)
    out = np.empty_like(late)
    y = out[0] = late[0]
    for i, (a, b) in enumerate(pairwise(late), start=1):
        slope = (b - a) / step
        y = b - slope * lag + (y - a + slope * lag) * decay
        out[i] = y
    return out
