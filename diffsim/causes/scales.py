"""Usual magnitudes that sizes of causes are stated in: one record, from fit runs and plain model.

Nothing of a test run is seen. A model is saved with the record, so that its sizes mean the same on
other recordings; a study with a ``frame`` has it from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from diffsim.core.checked import checked, checked_methods
from diffsim.data.study import Run, Study

SCALES = "scales"  # place in a study's frame
HELD = "held"  # another: commands that are held; a long record has it before it has scales
_NO_RANGE = 1e-12  # of a command that is the same throughout


@dataclass(frozen=True)
class CommandScale:
    """What a command does in the runs to fit."""

    # low, high: least and greatest value
    low: float
    high: float
    rate: float  # what its rate of change mostly stays below [1/s]


@checked_methods
@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class Scales:
    """Usual magnitudes over the runs to fit.

    Attributes:
        commands: What each command does, by name.
        channels: Least and greatest sample of each channel, by name; one apart if all are alike.
        longest_s: Duration of the longest run [s].
        num_orders: Number of places in the order of recording that the runs have.
        plain: Magnitudes of the plain model, by what they are of: {"cart": {"force": 2.1}}.
        facts: What else holds of the runs, by name: {"begins_moving": True}.
    """

    commands: Mapping[str, CommandScale]
    channels: Mapping[str, tuple[float, float]]
    longest_s: float
    num_orders: int
    plain: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    @checked(kinds_only=True)
    def of_runs(cls, study: Study) -> Scales:
        """Magnitudes of a study's recordings alone, without a model.

        Args:
            study: Study with the recordings; runs to test by have no say.
        """
        runs = study.fit_runs or study.without_tests().runs or study.runs
        names = dict.fromkeys(name for run in runs for name in run.command)
        channels = dict[str, tuple[float, float]]()
        for i, channel in enumerate(study.channels):
            seen = np.concatenate([np.zeros(0), *(run.measured[:, i] for run in runs)])
            seen = seen[np.isfinite(seen)]
            low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 0.0)
            channels[channel.name] = (low, high) if high > low else (low - 0.5, low + 0.5)
        return cls(
            MappingProxyType({name: _command_scale(runs, name) for name in names}),
            MappingProxyType(channels),
            max((float(r.time_s[-1] - r.time_s[0]) for r in runs), default=0.0),
            len({r.order for r in runs}),
        )

    @classmethod
    @checked(kinds_only=True)
    def of(cls, study: Study, plain: Mapping[str, Mapping[str, float]] | None = None) -> Scales:
        """The record that a study's ``frame`` has, else that of its runs to fit.

        Args:
            study: Study with the recordings.
            plain: Magnitudes of the plain model, where there is no record.
        """
        kept = cls.kept_in(study)
        return replace(cls.of_runs(study), plain=dict(plain or {})) if kept is None else kept

    @classmethod
    @checked(kinds_only=True)
    def kept_in(cls, study: Study) -> Scales | None:
        """The record that a study's ``frame`` has; None: it has none, as of no saved model.

        Raises:
            ValueError: the frame is that of a model which was saved before version 0.2.
        """
        if SCALES in study.frame:
            return cls.read(study.frame[SCALES])
        if study.frame.keys() - {HELD}:
            raise ValueError(
                f"study {study.name}: the saved model has no {SCALES!r}, by which its sizes mean "
                "what they mean; it is from before version 0.2: fit it again"
            )
        return None

    @classmethod
    @checked(kinds_only=True)
    def read(cls, saved: Mapping[str, Any]) -> Scales:
        """The inverse of ``saved``.

        Args:
            saved: What ``saved`` returned, of a file or not.
        """
        commands = {name: CommandScale(**scale) for name, scale in saved["commands"].items()}
        channels = {name: (low, high) for name, (low, high) in saved["channels"].items()}
        rest = {k: v for k, v in saved.items() if k not in ("commands", "channels")}
        return cls(MappingProxyType(commands), MappingProxyType(channels), **rest)

    def saved(self) -> dict[str, Any]:
        """The record in types that YAML and JSON have."""
        return {
            "commands": {name: asdict(scale) for name, scale in self.commands.items()},
            "channels": {name: list(ends) for name, ends in self.channels.items()},
            "longest_s": self.longest_s,
            "num_orders": self.num_orders,
            "plain": {of: dict(magnitudes) for of, magnitudes in self.plain.items()},
            "facts": dict(self.facts),
        }

    def require_plain(self, what: str, names: Sequence[str]) -> None:
        """Require the magnitudes of everything that opens causes among those of a saved model.

        Args:
            what: What the names are of, such as "place".
            names: Names in ``plain``.

        Raises:
            ValueError: what was described after the model was fitted.
        """
        if missing := [name for name in names if name not in self.plain]:
            known = ", ".join(self.plain) or "none"
            raise ValueError(
                f"{what} {missing[0]} is not in the saved model, which knows {known}; leave it "
                "out, or fit the model again"
            )

    def of_commands(self, names: Sequence[str]) -> dict[str, float]:
        """Magnitudes of commands that go the same way, as tables of causes call them.

        Args:
            names: Names of the commands; those that no run has count as zero.

        Returns:
            ``reach``, the greatest magnitude (1 where that is zero); ``width``, the greatest range;
            ``rate``.
        """
        own = [self.commands[name] for name in names if name in self.commands]
        reach = max((max(abs(c.low), abs(c.high)) for c in own), default=0.0)
        return {
            "reach": reach or 1.0,
            "width": max([_NO_RANGE, *(c.high - c.low for c in own)]),
            "rate": max([_NO_RANGE, *(c.rate for c in own)]),
        }

    def is_one_sided(self, names: Sequence[str]) -> bool:
        """Whether commands are never below zero.

        Args:
            names: Names of the commands.
        """
        return all(self.commands[name].low >= 0.0 for name in names if name in self.commands)

    def of_channels(self, names: Sequence[str]) -> dict[str, float]:
        """Magnitudes of channels of one instrument, as tables of causes call them.

        Args:
            names: Names of the channels.

        Returns:
            ``middle`` and ``width`` of all that they have shown; ``spread``, the greatest range of
            one of them; ``longest`` [s].
        """
        ends = [self.channels[name] for name in names]
        low, high = min(e[0] for e in ends), max(e[1] for e in ends)
        return {
            "middle": 0.5 * (low + high),
            "width": high - low,
            "spread": max(e[1] - e[0] for e in ends),
            "longest": self.longest_s,
        }


def _command_scale(runs: Sequence[Run], name: str) -> CommandScale:
    rates, seen = [0.0], [np.zeros(0)]
    for run in runs:
        if name not in run.command:
            continue
        values = np.asarray(run.command[name], dtype=np.float64)
        known = np.isfinite(values)
        seen.append(values[known])
        if known.sum() > 2:
            rate = np.abs(np.diff(values[known])) / np.diff(np.asarray(run.time_s)[known])
            rates.append(float(np.percentile(rate, 90)))
    every = np.concatenate(seen)
    if not len(every):
        return CommandScale(0.0, 0.0, 0.0)
    return CommandScale(float(every.min()), float(every.max()), max(rates))
