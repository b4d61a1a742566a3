"""Constants of a saved model in the words of other programs, by the formulas of a study."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from torch import Tensor

from diffsim.causes.formulas import is_number
from diffsim.causes.scales import SCALES
from diffsim.core.check import as_spelled, did_you_mean
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Run, Study
from diffsim.diagnose.judge.records import Interval
from diffsim.diagnose.say.wording import ends
from diffsim.identify.effect import effect_coordinates
from diffsim.identify.model_file import SavedModel
from diffsim.identify.ranges import Range, range_of
from diffsim.systems.description import quantities_of
from diffsim.systems.ode.network import filled
from diffsim.systems.ode.place_effects import STRIBECK
from diffsim.systems.registry import description_of, setup_of

EXPORT_FILE = "export.json"  # values with their intervals; programs read the files of values
ALL = "all"  # component of a cause that has a size for all runs, and what groups have beside it


@dataclass(frozen=True)
class ProgramConstants:
    """Constants for one program, of one device where the study has several."""

    program: str  # name of the program in the study's `export`
    group: Mapping[str, str]  # facts of the device, by name; empty: one for all runs
    constants: Mapping[str, Range]  # values with 90 % intervals, by name
    texts: Mapping[str, str]  # what the program reads beside them, such as the name of its model

    @property
    def title(self) -> str:
        """The program, and the device."""
        return ", ".join([self.program, *(f"{k} {v}" for k, v in self.group.items())])

    @property
    def stem(self) -> str:
        """Name of its file, without the ending."""
        return "_".join(re.sub(r"[^\w.-]", "-", s) for s in (self.program, *self.group.values()))

    def values(self) -> dict[str, float | str]:
        """Values by name, as the program reads them."""
        values = {name: constant.value for name, constant in self.constants.items()}
        return {**self.texts, **values}

    def ranges(self) -> dict[str, dict[str, float]]:
        """Values with both ends of their 90 % intervals, by name."""
        return {name: constant._asdict() for name, constant in self.constants.items()}


def constants_of(study: Study, saved: SavedModel) -> list[ProgramConstants]:
    """Values of the study's `export` formulas, by program and, where numbers differ, by device.

    Numbers that are known have their stated value, causes that the model has not have size 0.

    Args:
        study: The study with its `export`.

    Raises:
        ValueError: no `export`, or a formula with a name that there is not.
    """
    if not study.export:
        raise ValueError(
            f"{study.name}: no `export` in the study; name constants and their formulas, such as "
            "export: {mujoco: {damping: kt**2/resistance}}"
        )
    known, out = _ModelNumbers.of(study, saved), []
    for program, formulas in study.export.items():
        texts = {name: text[1:-1] for name, text in formulas.items() if is_text(text)}
        parsed = {n: known.read(text) for n, text in formulas.items() if n not in texts}
        for name, formula in parsed.items():
            known.require(f"export.{program}.{name}", formula)
        # what names facts of runs is each run's own: ``flown_constants``
        parsed = {n: f for n, f in parsed.items() if not known.of_run & set(f.names)}
        texts = _with_model(texts, {n: known.range_of(f, {}).value for n, f in parsed.items()})
        for group in _groups(study, known.facts_of(parsed.values())):
            constants = {name: known.range_of(formula, group) for name, formula in parsed.items()}
            out.append(ProgramConstants(program, group, constants, texts))
    return out


def flown_constants(study: Study, saved: SavedModel, program: str, run: Run) -> dict[str, float]:
    """Constants of a program in a run, by name; facts of the run are numbers, too.

    Args:
        study: The study with its `export`.
    """
    known = _ModelNumbers.of(study, saved)
    facts = {n: float(v) for n, v in run.setup.items() if is_number(v)}
    group = {str(n): str(v) for n, v in run.setup.items()}
    out = {}
    for name, text in study.export.get(program, {}).items():
        if not is_text(text):
            out[name] = known.value_of(known.read(text), group, facts, run.name)
    return out


#: BAM's models of friction by what they add to Coulomb and viscous friction
_BAM_ADDS = (("friction_stribeck",), ("load_friction_motor", "load_friction_external"))


def _with_model(texts: dict[str, str], values: Mapping[str, float]) -> dict[str, str]:
    """The smallest of BAM's models m1 to m5 that has all that is named."""
    if texts.get("model") != "m1":
        return texts
    fresh, loaded = (any(values.get(n, 0.0) for n in names) for names in _BAM_ADDS)
    apart = values.get("load_friction_motor") != values.get("load_friction_external")
    kind = (
        "m5"
        if loaded and apart
        else {(0, 0): "m1", (1, 0): "m2", (0, 1): "m3", (1, 1): "m4"}[int(fresh), int(loaded)]
    )
    return {**texts, "model": kind}


MANY = 4.0  # times: an end that is so far off bounds a number no more


def say_interval(found: Range) -> str:
    """The interval of a constant in brackets, with a word where an end of it says nothing."""
    value, low, high = found
    if low == high:
        return ""
    if low <= 0.0 < value and high <= MANY * value:
        return f" (at most {high:.2g})"
    if low <= 0.0 < value and high > MANY * value:
        return " (the runs do not bound it)"
    return f" ({ends(Interval(*found))})"


def notes_of(study: Study, saved: SavedModel) -> list[str]:
    """What a user must know of the constants, a sentence each."""
    known = _ModelNumbers.of(study, saved)
    texts = chain.from_iterable(formulas.values() for formulas in study.export.values())
    formulas = [known.read(text) for text in texts if not is_text(text)]
    names = list(dict.fromkeys(name for formula in formulas for name in formula.names))
    names = [name for name in names if name not in known.of_run]
    out = []
    if not saved.ranges:
        out.append(
            "The saved model has no intervals of an answer: these are of its fit alone, too narrow "
            "where anything is left; `diffsim diagnose explain` or `extend` writes them."
        )
    if absent := [n for n in names if n in known.absent and not known.is_fitted(n)]:
        out.append(f"Not in the model, so taken as 0: {', '.join(absent)}.")
    ends = tuple(saved.values)
    if own := [n for n in names if not known.is_fitted(n) and _is_of_runs(n, ends)]:
        out.append(f"Each run has its own, so taken as stated: {', '.join(own)}.")
    return out


def is_text(formula: str) -> bool:
    """Whether a formula is a text in quotes, which goes to the program as it is."""
    return len(formula) > 1 and formula[0] == formula[-1] == "'"


def _is_of_runs(name: str, saved: Sequence[str]) -> bool:
    return any(other.startswith(f"{name}@") for other in saved)


@dataclass(frozen=True)
class _ModelNumbers:
    """What formulas may ask for."""

    saved: SavedModel  # the answer
    # values that are known, and stated ones of those that are not fitted
    stated: Mapping[str, float]
    absent: frozenset[str]  # causes that the study may have and the answer may lack
    of_run: frozenset[str]  # facts that are numbers in each run, and no numbers of the model
    made: Mapping[str, Expression]  # what names stand for that are formulas of others

    @classmethod
    def of(cls, study: Study, saved: SavedModel) -> _ModelNumbers:
        described = description_of(study)
        stated = {**quantities_of(described), **getattr(described, "parameters", {})}
        setup = setup_of(saved.framed(study))
        causes = [*effect_coordinates(setup.effects), *described.effects.without]
        causes += [name.partition(".")[0] for name in causes if f".{ALL}" in name]
        sizes = dict.fromkeys(causes, 0.0)
        values = {name: float(quantity.value) for name, quantity in stated.items()}
        made = _list_stribeck_speeds(setup.model.frame, saved.values)
        facts = set.intersection(
            *({str(n) for n, v in run.setup.items() if is_number(v)} for run in study.runs)
        )
        known = sizes | values
        absent = frozenset(sizes) - frozenset(values)
        own = frozenset(facts) - {*known, *made, *saved.values}
        return cls(saved, known, absent, own, made)

    def read(self, text: str) -> Expression:
        """A formula of a study, by what the answer holds."""
        formula = parse_expression(text)
        known = (*self.stated, *self.saved.values, *self.of_run, *self.made)
        spelled = {name: parse_expression(as_spelled(name, known)) for name in formula.names}
        return filled(filled(formula, spelled), self.made)

    def require(self, where: str, formula: Expression) -> None:
        """Refuse a formula with a name that there is not.

        Raises:
            ValueError: it has one; the message names the closest.
        """
        names = {**self.stated, **self.saved.values, **dict.fromkeys((*self.of_run, *self.made))}
        for name in formula.names:
            if name not in names:
                raise ValueError(f"{where}: no number {name!r}{did_you_mean(name, list(names))}")

    def is_fitted(self, name: str) -> bool:
        """Whether the answer holds a number, for all runs or by groups."""
        return any(other == name or stem == name for other, stem, _ in self._parts())

    def facts_of(self, formulas: Iterable[Expression]) -> tuple[str, ...]:
        """Facts of the runs by which numbers of some formulas differ."""
        names = {name for formula in formulas for name in formula.names}
        return tuple(dict.fromkeys(fact for _, stem, fact in self._parts() if stem in names))

    def _parts(self) -> Iterator[tuple[str, str, str]]:
        """Saved numbers of groups: whole name, stem and fact; without a fact: "" for the latter."""
        for name in self.saved.values:
            found = re.fullmatch(r"(.+?)\.?\[(\w+)=.*\]", name)
            yield (name, found[1], found[2]) if found and found[2] != "run" else (name, name, "")

    def range_of(self, formula: Expression, group: Mapping[str, str]) -> Range:
        """Value and interval of a formula, for a device."""
        parts = {name: self._coordinates(name, group) for name in formula.names}
        stated = {name: self.stated[name] for name, own in parts.items() if not own}

        def at(values: Mapping[str, Tensor]) -> Tensor:
            numbers = {n: torch.tensor(v, dtype=torch.float64) for n, v in stated.items()}
            for name, own in parts.items():
                if own:
                    numbers[name] = torch.stack([values[c] for c in own]).sum(0)
            return formula(numbers)

        return range_of(at, list(chain.from_iterable(parts.values())), self.saved)

    def value_of(
        self, formula: Expression, group: Mapping[str, str], facts: Mapping[str, float], run: str
    ) -> float:
        """Value of a formula in a run, whose facts are numbers."""
        numbers = {}
        for name in formula.names:
            own = [*self._coordinates(name, group)]
            own += [c for c in (f"{name}@{run}",) if c in self.saved.values]
            if own:
                value = sum(self.saved.values[c] for c in own)
            else:
                value = self.stated[name] if name in self.stated else facts[name]
            numbers[name] = torch.tensor(value, dtype=torch.float64)
        return float(formula(numbers))

    def _coordinates(self, name: str, group: Mapping[str, str]) -> list[str]:
        """Saved numbers whose sum a name means for a device; none: it is known, or not there."""
        labels = [f"[{fact}={label}]" for fact, label in group.items()]
        wanted = [name, f"{name}.{ALL}"]
        wanted += [f"{name}{dot}{label}" for label in labels for dot in ("", ".")]
        return [c for c in wanted if c in self.saved.values]


def _list_stribeck_speeds(
    frame: Mapping[str, Any], values: Mapping[str, float]
) -> dict[str, Expression]:
    """Speed above which Stribeck friction at a place has gone, as its cause has it."""
    plain, made = frame.get(SCALES, {}).get("plain", {}), {}
    name = "fall_of_stribeck_friction"  # without a place where there is one alone
    for place, scale in plain.items():
        if isinstance(scale, Mapping) and "velocity" in scale:
            usual = repr(STRIBECK * float(scale["velocity"]))
            fall = next((n for n in (f"{name}_at_{place}", name) if n in values), "0")
            made[f"stribeck_speed_at_{place}"] = parse_expression(f"{usual}*exp({fall})")
    return made


def _groups(study: Study, facts: Sequence[str]) -> list[dict[str, str]]:
    """Devices of a study: values of some facts as its runs have them together."""
    facts = [fact for fact in facts if fact]
    rows = [tuple(str(run.setup.get(fact)) for fact in facts) for run in study.runs]
    return [dict(zip(facts, row, strict=True)) for row in dict.fromkeys(rows)]
