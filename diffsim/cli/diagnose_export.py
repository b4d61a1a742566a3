"""Constants of a saved model in the words of other programs, by the formulas of a study."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from diffsim.core.check import did_you_mean
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Study
from diffsim.identify.effect import effect_coordinates
from diffsim.identify.model_file import SavedModel
from diffsim.identify.ranges import Range, range_of
from diffsim.systems.description import quantities_of
from diffsim.systems.registry import description_of, setup_of

EXPORT_FILE = "export.json"  # values with their intervals; programs read the files of values
ALL = "all"  # component of a cause that has a size for all runs, and what groups have beside it


@dataclass(frozen=True)
class ProgramConstants:
    """Constants for one program, of one device where the study has several.

    Attributes:
        program: Name of the program in the study's `export`.
        group: Facts of the device, by name; empty: one for all runs.
        constants: Values with 90 % intervals, by name.
        texts: What the program reads beside them, such as the name of its model.
    """

    program: str
    group: Mapping[str, str]
    constants: Mapping[str, Range]
    texts: Mapping[str, str]

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
        saved: Its answer.

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
        texts = {name: text[1:-1] for name, text in formulas.items() if _is_text(text)}
        parsed = {n: parse_expression(text) for n, text in formulas.items() if n not in texts}
        for name, formula in parsed.items():
            known.require(f"export.{program}.{name}", formula)
        for group in _groups(study, known.facts_of(parsed.values())):
            constants = {name: known.range_of(formula, group) for name, formula in parsed.items()}
            out.append(ProgramConstants(program, group, constants, texts))
    return out


def notes_of(study: Study, saved: SavedModel) -> list[str]:
    """What a user must know of the constants, a sentence each."""
    known = _ModelNumbers.of(study, saved)
    texts = chain.from_iterable(formulas.values() for formulas in study.export.values())
    formulas = [parse_expression(text) for text in texts if not _is_text(text)]
    names = list(dict.fromkeys(name for formula in formulas for name in formula.names))
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


def _is_text(formula: str) -> bool:
    """Whether it is a text in quotes, which goes to the program as it is."""
    return len(formula) > 1 and formula[0] == formula[-1] == "'"


def _is_of_runs(name: str, saved: Sequence[str]) -> bool:
    return any(other.startswith(f"{name}@") for other in saved)


@dataclass(frozen=True)
class _ModelNumbers:
    """What formulas may ask for.

    Attributes:
        saved: The answer.
        stated: Values that are known, and stated ones of those that are not fitted.
        absent: Causes that the study may have and the answer may lack.
    """

    saved: SavedModel
    stated: Mapping[str, float]
    absent: frozenset[str]

    @classmethod
    def of(cls, study: Study, saved: SavedModel) -> _ModelNumbers:
        described = description_of(study)
        stated = {**quantities_of(described), **getattr(described, "parameters", {})}
        causes = [*effect_coordinates(setup_of(study).effects), *described.effects.without]
        causes += [name.partition(".")[0] for name in causes if f".{ALL}" in name]
        sizes = dict.fromkeys(causes, 0.0)
        values = {name: float(quantity.value) for name, quantity in stated.items()}
        return cls(saved, sizes | values, frozenset(sizes) - frozenset(values))

    def require(self, where: str, formula: Expression) -> None:
        """Refuse a formula with a name that there is not.

        Raises:
            ValueError: it has one; the message names the closest.
        """
        names = {**self.stated, **self.saved.values}
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

    def _coordinates(self, name: str, group: Mapping[str, str]) -> list[str]:
        """Saved numbers whose sum a name means for a device; none: it is known, or not there."""
        labels = [f"[{fact}={label}]" for fact, label in group.items()]
        wanted = [name, f"{name}.{ALL}"]
        wanted += [f"{name}{dot}{label}" for label in labels for dot in ("", ".")]
        return [c for c in wanted if c in self.saved.values]


def _groups(study: Study, facts: Sequence[str]) -> list[dict[str, str]]:
    """Devices of a study: values of some facts as its runs have them together."""
    facts = [fact for fact in facts if fact]
    rows = [tuple(str(run.setup.get(fact)) for fact in facts) for run in study.runs]
    return [dict(zip(facts, row, strict=True)) for row in dict.fromkeys(rows)]
