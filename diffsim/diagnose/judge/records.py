"""What a diagnosis says, as records: causes, base parameters, errors on unseen runs.

They are the content of ``report.json`` under ``causes``, ``base``, ``errors`` and ``outside``.
Every interval is one of 90 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite

import numpy as np

from diffsim.core.checked import checked
from diffsim.core.figures import figure
from diffsim.core.units import after_number, factor, small_scale
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.own_values import UNTOLD_PULL
from diffsim.identify import ranges

CERTAIN, LIKELY, UNTOLD = "certain", "likely", "cannot be told from"
REFUTED, HIDDEN, UNJUDGED = "refuted", "not visible below", "not judged"
STATUSES = (CERTAIN, LIKELY, UNTOLD, REFUTED, HIDDEN, UNJUDGED)
EFFECT, DATA_SHEET, UNKNOWN = "effect", "data sheet", "unknown"
ONE_LAW = "one law in place of all that undo each other"
WRONG_DATA_SHEET = "a wrong data sheet of "  # what may stand in place of a cause, before its name
RATIOS = ("stroke of", "rate of")  # quantities whose distance is a ratio to the largest fitted
SIGNALS = (*RATIOS, "level of", "frequency of")  # quantities of commands and channels
SURE = 0.99  # probability from which a cause is certain; that no right data sheet passes for wrong
LEVEL = ranges.LEVEL  # of every interval, and share of readings in the band of an unseen run
HALF_LEVEL = ranges.HALF_LEVEL  # half of a normal interval [sd]
#: Errors of a row, and half of its band
ERRORS = ("before", "after", "noise", "band", "constant", "held", "without", "command")
ALIKE_SHARE = 0.99  # of an error or a prior sd: what leaves more of it is alike, and no better


@checked(kinds_only=True)
@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval.

    Attributes:
        value: What the extended model holds; of a cause that it does not hold, the mean over the
            sets of causes that were weighed; in the row's unit.
        low, high: 90 % interval, in the row's unit.
    """

    value: float
    low: float
    high: float


@checked(kinds_only=True)
@dataclass(frozen=True)
class CauseRow:
    """What is known of one candidate cause.

    Attributes:
        name: Name of the effect, the base parameter or the unknown cause.
        words: The same in plain words, such as "sliding friction".
        origin: "effect" of the library, "data sheet" (a base parameter beyond the ``limit``
            of its row), or "unknown" (a smooth force or drift without a name).
        status: One of ``STATUSES``. "certain": in every set of causes within reach, and all of
            ``judge.preconditions`` hold; "likely": in sets of 80 % probability; "cannot be told
            from": of the causes in ``rivals``; "refuted": by runs that it was not fitted to, or by
            the evidence of a fit that would have shown it; "not visible below": the data do not
            ask for it, and could not show it below ``smallest_visible``.
        probability: Probability that it acts, over all sets that were weighed; None: not weighed.
        size: Size by component, its interval over the sets that hold it; empty without one. A
            "data sheet" cause has its value here, under its own name.
        unit: SI unit of the size, "-" if none.
        rivals: Names of the causes that it cannot be told from, or that act in its place.
        smallest_visible: Smallest size that these runs could show, by component, in ``unit``.
        gain: Share of the error that it removes from runs that it was not fitted to (those with
            use: select, or fit runs left out one after the other); None: not computed.
        removes: Share of the misfit above the noise that is back without it, all else of the
            extended model fitted again; None: not in it.
        helps: Whether the extended model holds it although it is not certain: it removes error, its
            name is not known.
        factor: How many times wider the interval is than noise alone would make it.
        note: What else is to be said, in a sentence.
        doubts: Why it is likely and not certain, each a clause.
        shown_unit: Unit in which a user reads the size; None: ``unit``.
        shown_times: What a size is multiplied by to be read in it; None: as the units say.
        shown_power: Power of the size that is read: -1 where it is stated per what is read.
    """

    name: str
    words: str
    origin: str
    status: str
    probability: float | None
    size: Mapping[str, Interval]
    unit: str
    rivals: tuple[str, ...] = ()
    smallest_visible: Mapping[str, float] = field(default_factory=dict)
    gain: Gain | None = None
    removes: float | None = None
    helps: bool = False
    factor: float = 1.0
    note: str = ""
    doubts: tuple[str, ...] = ()
    shown_unit: str | None = None
    shown_times: float | None = None
    shown_power: int = 1

    @property
    def read_unit(self) -> str:
        """Unit in which its size is read: ``shown_unit`` where that is another one, else small
        lengths in mm and so on; one over a size that may be zero has no bound, and is read as it
        is."""
        ends = [end for size in self.size.values() for end in (size.low, size.high)]
        if self.shown_power < 0 and not (ends and min(ends) > 0.0):
            return self.unit
        if self.shown_unit not in (None, self.unit) or self.shown_times is not None:
            return self.shown_unit or self.unit
        return small_scale(self.unit, ends or self.smallest_visible.values())[0]

    @property
    def sheet(self) -> str:
        """What a data sheet says, as its note has it: "0.4 +- 0.02"; empty without one."""
        return self.note.partition("data sheet: ")[2].partition(" (")[0]

    def as_read(self) -> CauseRow:
        """The same with sizes in the unit in which a user reads them."""
        unit = self.read_unit
        if unit == self.unit:
            return self
        per = unit if self.shown_power > 0 else f"1/({unit})"
        times = self.shown_times or factor(self.unit, per) ** self.shown_power
        size = {}
        for c, s in self.size.items():
            low, value, high = (times * v**self.shown_power for v in (s.low, s.value, s.high))
            size[c] = Interval(value, *sorted((low, high)))
        visible = {c: times * v for c, v in self.smallest_visible.items() if self.shown_power > 0}
        return replace(
            self, size=size, smallest_visible=visible, unit=unit, shown_unit=unit, shown_power=1
        )


@checked(kinds_only=True)
@dataclass(frozen=True)
class BaseRow:
    """A base parameter: what the data sheet says and what the recordings say.

    Attributes:
        name: Name of the parameter; "offset@run_3" is one of run_3 only.
        words: The same in plain words.
        unit: SI unit, "-" if none.
        value: Fitted value, in ``unit``.
        sd: Its standard deviation, in ``unit``.
        low, high: 90 % interval, in ``unit``.
        prior_value: Value of the data sheet, in ``unit``.
        prior_sd: Its standard deviation, in ``unit``.
        pull: Distance from the data sheet in prior standard deviations, with sign.
        limit: Distance from which on it is a finding: at least 3, more where many parameters could
            be off by chance.
        run: Run that it belongs to; None: all runs.
        finding: Whether it is a cause of its own: beyond ``limit``.
    """

    name: str
    words: str
    unit: str
    value: float
    sd: float
    low: float
    high: float
    prior_value: float
    prior_sd: float
    pull: float
    limit: float
    run: str | None = None
    finding: bool = False

    @property
    def is_told(self) -> bool:
        """Whether the recordings say anything of it: a shape of a cause that is absent is not."""
        return abs(self.pull) > UNTOLD_PULL or self.sd < ALIKE_SHARE * self.prior_sd

    def as_read(self) -> BaseRow:
        """The same in the unit in which it is read."""
        unit, times = small_scale(self.unit, (self.value, self.prior_value, self.prior_sd))
        names = ("value", "sd", "low", "high", "prior_value", "prior_sd")
        return replace(self, unit=unit, **{name: times * getattr(self, name) for name in names})


@checked(kinds_only=True)
@dataclass(frozen=True)
class ErrorRow:
    """Error on a run that was not fitted, root mean square over channels of one kind.

    Attributes:
        run: Name of the run.
        kind: Kind of the channels, such as "position".
        unit: Unit of the recordings' file.
        before: Error of the plain model at its own fit.
        after: Error of the extended model.
        noise: What noise alone leaves.
        num_samples: Number of samples that were compared.
        num_fitted: Number of values that were fitted to this run for either model: what the study
            declares unknown per run.
        use: "test", or "select" where there is no test run.
        band: Half of the width of the band for unseen runs, root mean square; None: no band.
        num_inside: Number of samples inside the band.
        constant: Error of the best constant of the fitted runs, their mean by channel; None: not
            known.
        held: Error of each channel's first reading of this run, held; None: too few samples.
        without: Error of the extended model without the values that were fitted to this run; None:
            there are none, or it cannot be simulated.
        command: Error of a command in the channel's unit, its delay and zero fitted to this run;
            None: there is none, or it was not asked for.
    """

    run: str
    kind: str
    unit: str
    before: float
    after: float
    noise: float
    num_samples: int
    num_fitted: int
    use: str = "test"
    band: float | None = None
    num_inside: int = 0
    constant: float | None = None
    held: float | None = None
    without: float | None = None
    command: float | None = None


def in_small_units(errors: Sequence[ErrorRow]) -> list[ErrorRow]:
    """Rows in the unit in which they are read, one for each kind of channel.

    Args:
        errors: Of the runs.
    """
    scales = {
        (row.kind, row.unit): small_scale(row.unit, (row.after, row.noise))
        for row in pooled_by_kind(errors)
    }
    out = []
    for row in errors:
        unit, times = scales[row.kind, row.unit]
        values = {name: getattr(row, name) for name in ERRORS}
        read = {name: times * v for name, v in values.items() if v is not None}
        out.append(replace(row, unit=unit, **read))
    return out


def pooled_by_kind(errors: Sequence[ErrorRow]) -> list[ErrorRow]:
    """All runs together, a row for each kind of channel."""
    kinds: dict[tuple[str, str], list[ErrorRow]] = {}
    for row in errors:
        kinds.setdefault((row.kind, row.unit), []).append(row)
    return [_pool(rows) for rows in kinds.values()]


def _pool(rows: Sequence[ErrorRow]) -> ErrorRow:
    weights, first = [row.num_samples for row in rows], rows[0]

    def rms(name: str) -> float:
        return float(np.sqrt(np.average([getattr(r, name) ** 2 for r in rows], weights=weights)))

    return ErrorRow(
        "all",
        first.kind,
        first.unit,
        rms("before"),
        rms("after"),
        rms("noise"),
        sum(weights),
        max(row.num_fitted for row in rows),
        first.use,
        constant=rms("constant") if all(row.constant is not None for row in rows) else None,
    )


def no_skill_words(errors: Sequence[ErrorRow]) -> list[str]:
    """Where the extended model is worse than what takes no skill, a sentence for each run."""
    out = []
    for row in errors:
        unit, times = small_scale(row.unit, (row.after, row.noise))
        better = {
            "a constant": row.constant,
            "the first reading, held,": row.held,
            "the command itself, late and shifted,": row.command,
        }
        said = [
            f"{what} would leave {figure(times * value)}{after_number(unit)}"
            for what, value in better.items()
            if value is not None and value < ALIKE_SHARE * row.after
        ]
        if said:
            out.append(
                f"Run {row.run}: the model has no skill in {row.kind}: it leaves "
                f"{figure(times * row.after)}{after_number(unit)}, {' and '.join(said)}."
            )
    return out


def band_share(errors: Sequence[ErrorRow]) -> float | None:
    """Share of the readings of test runs that lie inside the band; None where there is none."""
    # what chose between causes, and told the band, proves none
    rows = [row for row in errors if row.use == "test" and row.band is not None]
    return sum(row.num_inside for row in rows) / sum(r.num_samples for r in rows) if rows else None


def band_words(errors: Sequence[ErrorRow]) -> str:
    """The same in a sentence; empty where there is none."""
    if (share := band_share(errors)) is None:
        return ""
    count = sum(row.num_samples for row in errors if row.use == "test" and row.band is not None)
    ends = f"{100 * share:.0f} % of {count} readings of unseen runs."
    return f"The {100 * LEVEL:.0f} % band holds {ends}"


@checked(kinds_only=True)
@dataclass(frozen=True)
class OutsideRow:
    """A quantity of a test run beside the range that was fitted.

    Attributes:
        run: Name of the test run.
        what: What was compared, such as "level of force_N", "rate of force_N", "payload_kg".
        value: Value in the test run; a label as text.
        low, high: Range over the fitted runs; None for labels.
        times: How far outside, at most 1 is inside: strokes and rates over the largest fitted one,
            else from the middle of the range over half its width; infinite for an unknown label.
        unit: Unit of value and range.
    """

    run: str
    what: str
    value: float | str
    low: float | None
    high: float | None
    times: float
    unit: str = ""

    @property
    def is_fact(self) -> bool:
        """Whether it is a fact of the set-up, and nothing of a signal."""
        return not self.what.startswith(SIGNALS)

    @property
    def words(self) -> str:
        """The row in a sentence."""
        unit = f" {self.unit}" if self.unit not in ("", "-") else ""
        if isinstance(self.value, str) or self.low is None or self.high is None:
            return f"Run {self.run}: no fitted run has {self.what} {self.value}."
        per, unit = (1000.0, " mm") if self._in_mm else (1.0, unit)
        numbers = [figure(per * v) for v in (self.value, self.low, self.high)]
        said = f"Run {self.run}: {self.what} is {numbers[0]}{unit}, fitted runs have "
        if self.low == self.high:
            return f"{said}{numbers[1]}{unit}."
        of = "the largest" if self.what.startswith(RATIOS) else "as far from the middle"
        times = figure(self.times, 2)
        is_told = isfinite(self.times) and times != "1"
        far = f" ({times} times {of})" if is_told else ""
        return f"{said}{numbers[1]} to {numbers[2]}{unit}{far}."

    @property
    def _in_mm(self) -> bool:
        ends = (self.value, self.low, self.high)
        return self.unit == "m" and all(abs(v) < 1.0 for v in ends if isinstance(v, float))
