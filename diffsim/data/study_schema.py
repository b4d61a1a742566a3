"""Keys of ``study.yaml``: what was measured, what was commanded, which run is which rows of a file.

Every key is told once, in its description; docs/study_keys.md is written from these.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainValidator,
    field_validator,
    model_validator,
)

from diffsim.core.expression import parse_expression
from diffsim.core.inside import require_file_name
from diffsim.core.schema import KindWords, Part, standing_alone
from diffsim.core.schema_paths import FolderAnywhere, PathInside
from diffsim.core.units import to_si
from diffsim.data.decode import Decode
from diffsim.data.fault_keys import FaultKeys
from diffsim.data.stamps import Duplicates, Stamps
from diffsim.data.study_types import (
    Every,
    Files,
    FillValue,
    Formula,
    Number,
    PerRun,
    Place,
    Positive,
    Texts,
    Unit,
    UseOfBlocks,
    UseOfRuns,
    Value,
    Values,
    Zero,
    ZeroTime,
    in_own_unit,
)


def _number_as_text(given: Any) -> Any:
    return repr(given) if type(given) in (int, float) else given


FormulaText = Annotated[str, BeforeValidator(_number_as_text)]


def _wrap_in_list(given: Any) -> Any:
    return given if isinstance(given, (list, tuple)) and given else [given]


MOST_BLOCKS = 10_000  # pieces of a run


class TimeSource(Part):
    """Clock of the files."""

    column: str | None = Field(None, description="Column that holds the time; default: `time_s`")
    unit: str = Field(
        "s", description="Unit of that column: s, ms, us, min; `clock` for 12:30:05.25 or a date"
    )
    zero: Zero | None = Field(
        None,
        description="Reading of that column that is 0 s, in `unit`; `start`: its first. It joins "
        "instruments that were started together, whatever their clocks count from",
    )
    step: Positive | None = Field(
        None,
        description="Seconds between rows, where the files have no clock; with `column`, seconds "
        "for each count of it: {column: frame, step: 0.01}",
    )

    @field_validator("unit")
    @classmethod
    def _is_time(cls, unit: str) -> str:
        if unit != "clock" and to_si(unit).unit != "s":
            raise ValueError(f"must be a unit of time such as s or ms, or clock, got {unit!r}")
        return unit

    @model_validator(mode="after")
    def _one_source(self) -> TimeSource:
        if self.step is not None and self.unit != "s":
            raise ValueError(f"step counts in seconds; leave out unit, got {self.unit!r}")
        return self


Times = Annotated[
    tuple[TimeSource, ...], BeforeValidator(_wrap_in_list), KindWords("TimeSource, or list of them")
]


class TableFormat(Part):
    """Lay-out of CSV files; delimiter, decimal comma and encoding are recognized."""

    header_line: int = Field(
        1, ge=0, description="Line of the file that has the names of columns; 0: none has"
    )
    first_line: int | None = Field(
        None, ge=1, description="Line of the first sample; default: the one after the header"
    )
    columns: Texts = Field(
        (),
        description="Names of the columns in their order, in place of the header's: "
        "[time, steering, speed]. Default without a header: column_1, column_2, ...",
    )

    @model_validator(mode="after")
    def _samples_below(self) -> TableFormat:
        if self.first_line is not None and self.first_line <= self.header_line:
            raise ValueError(
                f"first_line must be below header_line, got {self.first_line} and "
                f"{self.header_line}"
            )
        return self


Formats = Annotated[
    tuple[TableFormat, ...],
    BeforeValidator(_wrap_in_list),
    KindWords("TableFormat, or list of them"),
]


class Source(Part):
    """Where the samples of a quantity are in the files."""

    column: str | None = Field(None, description="Column of the files; default: the name")
    formula: Formula | None = Field(
        None,
        description="Instead of a column: formula of columns, facts of `setup` and `t`, the time "
        "of the run in s; other names than a_1 are written in backquotes: 0.5*(`x 1` + `x 2`)",
    )
    file: Place | None = Field(
        None,
        description="Which of the run's files holds the column, from 1, where several have one of "
        "that name; default: the first that has it",
    )
    decode: Decode | None = Field(
        None, description="How numbers of its columns are coded: {wrap: 4096}, {sign_bit: 15}"
    )
    scale: Number = Field(1.0, description="The column is multiplied by this")
    offset: Number = Field(0.0, description="Added after `scale`, in `unit`")
    unwrap: Positive | None = Field(
        None,
        description="What is read goes on over the ends of a range of this size, in `unit`, such "
        "as 360 of an angle in deg: last of all",
    )

    at_most_one: ClassVar = ("column", "formula")


class BoundedSource(Source):
    """A quantity with limits."""

    in_unit: ClassVar[dict[str, str]]
    """Further keys that may have a unit of their own, and what they are of the quantity."""

    lower: Number | None = None
    upper: Number | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_units(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("shown_formula") is not None:
            if given.get("shown_unit") is None:
                raise ValueError("shown_formula needs shown_unit, the unit of what it gives")
            parse_expression(given["shown_formula"], [str(given.get("name"))])
        ends = {"lower": "value", "upper": "value", "offset": "difference"}
        return in_own_unit(given, ends | cls.in_unit)

    @model_validator(mode="after")
    def _check_bounds(self) -> BoundedSource:
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(f"lower must be below upper, got {self.lower:g} and {self.upper:g}")
        return self


class ChannelEntry(BoundedSource):
    """A measured quantity."""

    in_unit: ClassVar = {"sd": "difference"}

    name: str = Field(description="Name that the model, reports and formulas use")
    unit: Unit = Field(description="Unit of the files, such as mm, deg, mbar, rpm; - for none")
    kind: str | None = Field(
        None,
        description="Kind of quantity: position, angle, velocity, force, pressure, flow, ...; "
        "default: what the unit measures",
    )
    sensor: str | None = Field(
        None,
        description="Instrument that shows it, such as camera or encoder: channels of one share "
        "its clock, lag and scale. Default: tried by kind, and channel by channel where a kind has "
        "few",
    )
    sd: Positive | None = Field(
        None,
        description="Standard deviation of the sensor's noise, in `unit` or with its own, such as "
        "2 mm; default: from repeats",
    )
    zero_s: tuple[Number, Number] | None = Field(
        None,
        description="From and until [s, clock of the files]: the mean over this time is "
        "subtracted, so that the channel is a change from a state at rest",
    )
    shown_unit: Unit | None = Field(
        None,
        description="Unit in which reports show errors; default: `unit`, for degC kelvins",
    )
    shown_formula: Formula | None = Field(
        None,
        description="Of a scaled reading: what reports show, in `shown_unit`, as a formula of the "
        "channel's name, such as 0.2*sinh(0.01*scaled)/0.01 in kPa",
    )
    lower: Number | None = Field(
        None, description="How far the rig may travel, in `unit`: `next` advises no run beyond it"
    )
    upper: Number | None = Field(None, description="The other end of its travel, in `unit`")


class CommandEntry(BoundedSource):
    """A commanded quantity."""

    in_unit: ClassVar = {"fill": "value", "before": "value", "rate": "rate"}

    name: str = Field(description="Name that the model, reports and formulas use")
    unit: Unit | None = Field(
        None, description="Unit of the files; default: SI, as the name should end (`force_N`)"
    )
    lower: Number | None = Field(
        None, description="Least value that can be commanded, in `unit`, or as 5 N"
    )
    upper: Number | None = Field(None, description="Largest value that can be commanded, in `unit`")
    rate: Positive | None = Field(None, description="Fastest change, in `unit` per second")
    before: Number | None = Field(
        None,
        description="What was commanded before a run begins, in `unit`: a delay or a limit sees a "
        "step at its first row; default: a run's first value",
    )
    fill: FillValue | None = Field(
        None,
        description="Value where a cell is empty: hold (the last one; before the first, the "
        "first), linear (in between), or a number in `unit`. hold also keeps a value of a further "
        "file until that file's next sample, where straight lines are drawn otherwise",
    )
    shown_unit: Unit | None = Field(
        None, description="Unit in which reports show it; default: `unit`"
    )
    is_measured: bool = Field(
        False,
        description="Whether it was measured (the output of a controller): it then differs "
        "between repeats, and nobody can command it",
    )


class Fact(Part):
    """A fact of a run that is read from its file."""

    column: str | None = Field(None, description="Column of the files; default: the fact's name")
    formula: Formula | None = Field(None, description="Instead of a column: formula of columns")
    value: Value | None = Field(
        None, description="Instead of a column: a value with a `unit`, or a part of the file's name"
    )
    unit: Unit = Field("-", description="Unit of the file; the fact is held in SI units")
    take: Literal["constant", "first", "last", "mean"] = Field(
        "constant", description="Which sample: constant (all must agree), first, last or mean"
    )


class Blocks(Part):
    """A long run cut into pieces, each a run of its own: name_1, name_2, ..."""

    num: int | None = Field(
        None, ge=2, le=MOST_BLOCKS, description="Number of pieces of equal length"
    )
    length_s: Positive | None = Field(None, description="Length of a piece [s], in place of `num`")
    use: UseOfBlocks = Field(
        {}, description="Pieces by use, counted from 1; all others have the run's `use`"
    )
    restart_time: bool = Field(False, description="Whether each piece begins at 0 s")
    run_up: bool = Field(
        False,
        description="Whether each piece is simulated from the beginning of the run, while only its "
        "own samples are compared: then all pieces share one start",
    )

    one_of: ClassVar = ("num", "length_s")


class OtherSource(Source):
    """Where a channel or command is in a file that has it elsewhere."""

    unit: Unit | None = Field(
        None, description="Unit of this file, of the same quantity; default: that of the channel"
    )


def _read_elsewhere(given: Any) -> OtherSource | None:
    if given is None:
        return None
    return OtherSource.model_validate({"column": given} if isinstance(given, str) else given)


Elsewhere = Annotated[
    OtherSource | None, PlainValidator(_read_elsewhere), KindWords("column, OtherSource or null")
]


class RunKeys(Part):
    """What can be said of one run, or of all by ``defaults``."""

    use: UseOfRuns = Field(
        "fit",
        description="fit, select (chooses between causes) or test (touched once, at the end); or "
        "a mapping of uses to values of `split` or names of runs; others are fit, or test where "
        "those to fit are listed: {test: [7, 9], select: [3]}, {fit: [1, 2]}",
    )
    setup: dict[str, Any] = Field(
        {},
        description="Facts of the run by name: a number, a label, `column` (the constant of the "
        "column of that name), or {column, unit, take}, {value, unit}, {formula, unit}",
    )
    time: Times | None = Field(None, description="Clock of this run's files, if another")
    from_s: PerRun | None = Field(
        None, description="First time that is used [s, clock of the file]; by value of `split` too"
    )
    until_s: PerRun | None = Field(
        None, description="Time from which on nothing is used [s, clock of the file]"
    )
    zero_time: ZeroTime | None = Field(
        None, description="Time of the file that becomes 0 s; `start`: the first sample used"
    )
    zero_when: Formula | None = Field(
        None,
        description="0 s is where this formula is true at first, such as pressure > 100; of "
        "columns, facts, or channels in SI units, counted from their `zero_s`",
    )
    before_zero_s: Number | None = Field(None, description="Time that is used before 0 s [s]")
    after_zero_s: Number | None = Field(None, description="Time that is used after 0 s [s]")
    every: Every = Field(
        1,
        description="Each n-th sample is used; or n by the time from which on it holds, "
        "{0: 3, 1.5: 30}: each third, from 1.5 s on each thirtieth",
    )
    average: bool = Field(False, description="Whether `every` n samples are averaged into one")
    missing_if: Formula | None = Field(
        None,
        description="Where this formula is true, nothing was measured; of columns, facts, and "
        "channels and commands in SI units",
    )
    duplicates: Duplicates | None = Field(
        None,
        description="Rows with equal stamps: the first, the last or the mean of them is used, or "
        "they are spread evenly until the next stamp, as of a clock that counts too coarsely",
    )
    stamps: Stamps | None = Field(
        None, description="Stamps that are missing, go back or jump: what is done to them"
    )
    gaps: Literal["line"] | None = Field(
        None,
        description="Where rows were lost: line puts them back without measurements, and commands "
        "on straight lines",
    )
    columns: dict[str, Elsewhere] = Field(
        {},
        description="Channels and commands that this file has elsewhere: {name: column}, "
        "{name: {column, formula, unit}}, or {name: null} where it was not recorded",
    )


class RunEntry(RunKeys):
    """One run, or all that a pattern, a table or the values of a column make."""

    name: str | None = Field(
        None,
        description="Name; {file}, {toss} stand for the file's name and for values of `split`, "
        "`table` or the file's pattern. Default: the file's name with the values",
    )
    file: Files = Field(
        (),
        description="CSV file, or one of another format (Parquet, HDF5, MAT, NPZ, XLSX, ULog, "
        "MCAP, rosbag), `FILE#PART` where it holds several tables. `*` or {level} in it: each file "
        "that fits is a run. A list: further files are read at the clock of the first; one "
        "without a clock has a row for each row of the first, or one fewer. Default: the name with "
        ".csv",
    )
    table: PathInside | None = Field(
        None, description="CSV file that lists runs: each row is one, its cells are used as {cell}"
    )
    split: Texts = Field((), description="Columns: each value, or pair of values, is a run")
    where: dict[str, Any] = Field(
        {},
        description="Rows that are used (of `table` if there is one), by column: a value, a list, "
        "or {at_least, below}",
    )
    group: str | None = Field(
        None,
        description="Runs of one group executed the same command; {} as in `name`. Default: none",
    )
    repeat_of: str | None = Field(None, description="Run whose command was executed again")
    order: int | None = Field(
        None,
        ge=-(10**15),
        le=10**15,
        description="Place in the sequence of experiments; default: place in the list",
    )
    row_s: Number | None = Field(
        None,
        gt=0,
        description="Usual time between rows as recorded, where the file has only some [s]",
    )
    blocks: Blocks | None = Field(None, description="Cut the run into pieces")

    at_most_one: ClassVar = ("group", "repeat_of")

    @model_validator(mode="after")
    def _has_a_file(self) -> RunEntry:
        if not self.file and self.name is None and self.table is None:
            raise ValueError("has neither file nor name")
        return self


class StudyFile(Part):
    """What was measured, what was commanded, in which runs, of which system."""

    name: Annotated[str, AfterValidator(partial(require_file_name, "name"))] = Field(
        description="Short name, as reports and the folder of results show it"
    )
    like: PathInside | None = Field(
        None,
        description="Rig that is ready (position_servo), or another study's file in this one's "
        "folder: its keys hold where this file states none. Entries of lists are joined by `name`; "
        "null takes a key away",
    )
    system: str | None = Field(
        None, description="What was recorded, in a word, of studies without `model`"
    )
    model: dict[str, Any] | None = Field(
        None, description="Description of the system; its keys depend on `system`, see below"
    )
    data: FolderAnywhere | None = Field(
        None,
        description="Folder of the files: of a published data set by name, or a path from here. "
        "Default: the folder of study.yaml",
    )
    model_folder: FolderAnywhere | None = Field(
        None, description="Folder that files of `model` are in; default: that of `data`"
    )
    time: Times = Field(
        (),
        description="Clock of the files; or several, of which each file has the first whose column "
        "it holds: [{column: t_ms, unit: ms}, {column: stamp}]",
    )
    table: Formats = Field(
        (TableFormat(),),
        description="Lay-out of the files; or a list, one for each file of a run: "
        "[{header_line: 0, columns: [time]}, {header_line: 0, columns: [x, y]}]",
    )
    channels: tuple[ChannelEntry, ...] = Field(description="What was measured")
    commands: tuple[Annotated[CommandEntry, standing_alone("name", str)], ...] = Field(
        (), description="What was commanded: a name, or a mapping"
    )
    defaults: RunKeys = Field(RunKeys(), description="Keys that hold for all runs")
    runs: tuple[RunEntry, ...] = Field(description="Which rows of which files are which run")
    allows: dict[str, Values] = Field(
        {},
        description="Facts of `setup` that can be changed for a next run, with possible values: "
        "{payload_kg: [0, 0.1, 0.3]}",
    )
    ignore: Texts = Field(
        (),
        description="Columns that nothing may be read from, such as what others computed: "
        "`residual_*`",
    )
    faults: FaultKeys | None = Field(
        None, description="Groups of runs that are each judged for a fault: `diagnose faults`"
    )
    export: dict[str, dict[str, FormulaText]] = Field(
        {},
        description="Constants for other programs, by program and name: formulas of the model's "
        "numbers and causes, for `diagnose export`: {mujoco: {damping: kt**2/resistance}}. A text "
        "in quotes of its own goes out as it is: {bam: {model: \"'m1'\"}}",
    )
    metadata: dict[str, Any] = Field({}, description="Anything else worth keeping: source, licence")
    todo: Texts = Field((), description="What is still to be stated; `check` repeats it")

    @field_validator("commands", mode="before")
    @classmethod
    def _none_is_empty(cls, given: Any) -> Any:
        return () if given is None else given
