"""Extended models as files: ``extended_model.yaml``, written by a diagnosis, read to simulate.

::

    model: multicopter
    study: lab_flights
    verdict: named
    numerics: {time_step: 0.5, mesh: 1.0, tolerance: 1.0}  # factors; only where refined
    prepared_at: null            # where the model prepared what it prepares once (standardized)
    parameters:                  # of the plain model, nuisances too
      mass: {value: 1.41, sd: 0.004, unit: kg, low: 1.39, high: 1.43}  # 90 % interval of the answer
    effects:                     # sizes; components of vector effects as "wind.north"
      wind.north: {value: 0.31, sd: 0.01, unit: N}
    frame: {labels: ...}         # what the causes took from the fitted runs: labels, magnitudes
    plain:                       # parameters of the plain model at its own fit
      mass: {value: 1.52, sd: 0.003, unit: kg}
    correlation:                 # of the posterior, each with those before it; not of single runs
      wind.north: {mass: 0.31}
    facts: ...                   # noise floor, fitted runs and their range: to judge new runs by
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.core.files import to_plain, write_text_atomic
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.study import Study
from diffsim.identify.effect import PRIOR_WIDTH, Effect, effect_coordinates, is_of_run
from diffsim.identify.extended import ExtendedModel, extended_at
from diffsim.identify.fitting import Fit, correlated
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import REFINEMENTS, Numerics, coarse
from diffsim.identify.ranges import SURE_SD, Range, range_of_number
from diffsim.identify.setup import DiagnosisSetup

MODEL_FILE = "extended_model.yaml"
_ENTRY_KEYS = ("value", "sd", "unit")


@dataclass(frozen=True)
class SavedModel:
    """Content of an ``extended_model.yaml``."""

    path: Path  # file that the model was read from
    # values, sd: fitted value and its standard deviation by name of parameter or component, each in
    # its unit
    values: Mapping[str, float]
    sd: Mapping[str, float]
    parameters: tuple[str, ...]  # names of the plain model's parameters
    components: tuple[str, ...]  # names of the effects' components
    verdict: str = ""  # verdict of the diagnosis that fitted the model
    units: Mapping[str, str] = field(default_factory=dict)  # unit by name of parameter or component
    # standardized parameters at which the model prepared what it prepares once
    prepared_at: Mapping[str, float] | None = None
    # parameters of the plain model at its own fit, by name, in their units; empty in files of
    # before
    plain: Mapping[str, float] = field(default_factory=dict)
    # what judging new runs needs beside the model: noise floor, fitted runs, their range
    facts: Mapping[str, Any] = field(default_factory=dict)
    # refined numerical settings of the fits; None: the model's own
    numerics: Numerics | None = None
    # what the causes took from the fitted runs, for a study of other runs
    frame: Mapping[str, Any] = field(default_factory=dict)
    # of the posterior, by name with names before it; what is not there is 0
    correlation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    # model, study: names of the plain model and of the study that it was fitted to
    model: str = ""
    study: str = ""
    # 90 % intervals as the answer states them, by name: over all sets of causes, with what is left
    # over. ``sd`` is of the fit alone. Empty in files of before.
    ranges: Mapping[str, Range] = field(default_factory=dict)

    def correlation_of(self, a: str, b: str) -> float:
        """Of two sizes in the posterior; 0 where the file does not say."""
        if a == b:
            return 1.0
        rows = self.correlation
        return float(rows.get(a, {}).get(b, rows.get(b, {}).get(a, 0.0)))

    def draw(self, names: Sequence[str], count: int, rng: np.random.Generator) -> Tensor:
        """Values that the answer allows, as ``Range.drawn`` has them.

        Args:
            names: Parameters and components, in the order wanted.
            count: Number of draws.
            rng: Source of chance.

        Returns:
            (count, len(names)), each in its unit, with the file's correlations; normal draws are
            cut at 3 standard deviations before they are stretched to intervals.
        """
        normal = self._normal(names, count, rng)
        drawn = [range_of_number(self, n).drawn(z) for n, z in zip(names, normal.mT, strict=True)]
        return torch.stack(drawn, 1) if drawn else normal

    def draw_coordinates(
        self, base: Sequence[Parameter], count: int, rng: np.random.Generator
    ) -> Tensor:
        """The same as standardized coordinates, (count, num_base).

        Args:
            base: Parameters of the rebuilt model; those without an interval in the file, such as
                nuisances of a new run, are drawn from their priors.
            rng: Source of chance.
        """
        normal = self._normal([p.name for p in base], count, rng)
        for k, p in enumerate(base):
            if p.name in self.ranges:
                values = self.ranges[p.name].drawn(normal[:, k]).tolist()
                normal[:, k] = normal.new_tensor([p.coordinate_of(v) for v in values])
        return normal

    def _normal(self, names: Sequence[str], count: int, rng: np.random.Generator) -> Tensor:
        unit = torch.from_numpy(rng.standard_normal((count, len(names))))
        return correlated(unit, names, self.correlation_of).clamp(-SURE_SD, SURE_SD)

    def framed(self, study: Study) -> Study:
        """A study of new runs, its causes as they were where the model was fitted."""
        return replace(study, frame=self.frame)


@checked
def save_extended(
    fit: Fit,
    path: str | Path,
    *,
    study: Study,
    verdict: str,
    plain: Fit | None = None,
    facts: Mapping[str, Any] | None = None,
    ranges: Mapping[str, Range] | None = None,
) -> Path:
    """Write a fit as an extended model.

    Args:
        fit: Fit with or without effects.
        path: File to be written.
        study: Study that was fitted.
        verdict: Verdict of the diagnosis that fitted the model.
        plain: Fit of the plain model, to compare with; None: ``fit`` without its effects is not
            compared with anything.
        facts: What judging new runs needs beside the model, in types that YAML has.
        ranges: 90 % intervals by name, each in its unit; None: the fit's standard deviations alone.
    """
    problem, entries = fit.problem, _entries(fit)
    for name, known in (ranges or {}).items():
        entries[name] |= {"low": known.low, "high": known.high}
    count, prepared = problem.num_base, problem.model.prepared_q
    content = {
        "model": problem.model.name,
        "study": study.name,
        "verdict": verdict,
        **(
            {}
            if problem.reference_numerics is None
            else {"numerics": asdict(problem.reference_numerics)}
        ),
        "prepared_at": None
        if prepared is None
        else dict(zip(problem.names, prepared.tolist(), strict=False)),
        "parameters": dict(list(entries.items())[:count]),
        "effects": dict(list(entries.items())[count:]),
        **({"correlation": correlation} if (correlation := _correlation(fit)) else {}),
        **({"frame": dict(problem.model.frame)} if problem.model.frame else {}),
        **({} if plain is None else {"plain": _entries(plain)}),
        **({} if facts is None else {"facts": dict(facts)}),
    }
    return write_text_atomic(path, yaml.safe_dump(to_plain(content), sort_keys=False))


def _entries(fit: Fit) -> dict[str, dict[str, Any]]:
    """Value, sd and unit of every coordinate of a fit."""
    problem = fit.problem
    units = [p.unit for p in problem.model.base] + [e.unit for e, _ in problem.owners]
    return {
        name: {"value": fit.values[name], "sd": fit.sd[name], "unit": unit}
        for name, unit in zip(problem.names, units, strict=True)
    }


def _correlation(fit: Fit) -> dict[str, dict[str, float]]:
    """Correlations of what all runs share, each with those before it; tiny ones are left out."""
    names = list(fit.problem.names)
    shared = [i for i, name in enumerate(names) if "@" not in name]
    out: dict[str, dict[str, float]] = {}
    for i in shared:
        row = {names[j]: round(float(fit.correlation[i, j]), 8) for j in shared if j < i}
        if row := {name: r for name, r in row.items() if abs(r) >= 0.01}:
            out[names[i]] = row
    return out


def read_extended(path: str | Path) -> SavedModel:
    """Read the file; a folder stands for the ``extended_model.yaml`` in it.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a file; the message names the entry.
    """
    path = Path(path)
    path = path / MODEL_FILE if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such extended model; make one with `diffsim diagnose explain`"
        )
    content = read_yaml_file(path)
    parts: dict[str, dict[str, Any]] = {}
    for part in ("parameters", "effects", "plain"):
        given = content.get(part) if isinstance(content, dict) else None
        if given is None and part == "plain" and isinstance(content, dict):
            given = {}
        if not isinstance(given, dict):
            raise ValueError(f"{path}: {part} must be a mapping of names to value, sd and unit")
        parts[part] = given
    if "made_from" in (content.get("facts") or {}):
        raise ValueError(
            f"{path}: written by an earlier version, which kept magnitudes elsewhere; write it "
            "again with `diffsim diagnose explain`"
        )
    entries = {**parts["parameters"], **parts["effects"]}
    for name, entry in (*entries.items(), *parts["plain"].items()):
        _require_entry(f"{path}: {name}", entry)
    return SavedModel(
        path=path,
        values={name: float(entry["value"]) for name, entry in entries.items()},
        sd={name: float(entry["sd"]) for name, entry in entries.items()},
        parameters=tuple(parts["parameters"]),
        components=tuple(parts["effects"]),
        verdict=str(content.get("verdict", "")),
        units={name: str(entry.get("unit", "-")) for name, entry in entries.items()},
        prepared_at=_numbers(path, content, "prepared_at"),
        plain={name: float(entry["value"]) for name, entry in parts["plain"].items()},
        facts=_mapping(path, content, "facts"),
        numerics=_numerics(path, _mapping(path, content, "numerics")),
        frame=_mapping(path, content, "frame"),
        correlation=_correlations(path, content),
        model=str(content.get("model", "")),
        study=str(content.get("study", "")),
        ranges={
            name: Range(*(float(entry[key]) for key in Range._fields))
            for name, entry in entries.items()
            if "low" in entry
        },
    )


def _require_entry(what: str, entry: Any) -> None:
    """Numbers must be finite, the standard deviation not negative, the value in its interval."""
    if not isinstance(entry, dict) or not {"value", "sd"} <= set(entry):
        raise ValueError(f"{what} must have {', '.join(_ENTRY_KEYS)}, got {entry!r}")
    ends = tuple(key for key in ("low", "high") if key in entry)
    if len(ends) == 1:
        raise ValueError(f"{what} must have both low and high, or neither, got {entry!r}")
    for key in ("value", "sd", *ends):
        least = 0.0 if key == "sd" else -math.inf
        try:
            require_number(f"{what}: {key}", entry[key], at_least=least)
        except (TypeError, OverflowError) as error:
            raise ValueError(str(error)) from None
    if ends and not entry["low"] <= entry["value"] <= entry["high"]:
        raise ValueError(f"{what}: value must lie from low to high, got {entry!r}")


def _mapping(path: Path, content: Mapping[str, Any], key: str) -> dict[str, Any]:
    given = content.get(key)
    if given is None:
        return {}
    if not isinstance(given, dict):
        raise ValueError(f"{path}: {key} must be a mapping, got {type(given).__name__}")
    return given


def _numbers(path: Path, content: Mapping[str, Any], key: str) -> dict[str, Any] | None:
    if content.get(key) is None:
        return None
    given = _mapping(path, content, key)
    for name, value in given.items():
        _require_entry(f"{path}: {key}.{name}", {"value": value, "sd": 0.0})
    return given


def _correlations(path: Path, content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Correlations of the file, each a number from -1 to 1."""
    given = _mapping(path, content, "correlation")
    for name in given:
        for other, value in _mapping(path, given, name).items():
            what = f"{path}: correlation.{name}.{other}"
            try:
                require_number(what, value, at_least=-1.0, at_most=1.0)
            except (TypeError, OverflowError) as error:
                raise ValueError(str(error)) from None
    return given


def _numerics(path: Path, given: Mapping[str, Any]) -> Numerics | None:
    """Numerical settings of the file, by the names that they have here."""
    known = [f.name for f in fields(Numerics)]
    for name, value in given.items():
        require_choice(f"{path}: numerics", name, known)
        try:
            require_number(f"{path}: numerics.{name}", value, above=0.0)
        except TypeError as error:
            raise ValueError(str(error)) from None
    return Numerics(**given) if given else None


def without_effects(saved: SavedModel) -> SavedModel:
    """The plain model of a file, at its own fit.

    Raises:
        ValueError: a file of before, which does not hold it.
    """
    if not saved.plain:
        raise ValueError(
            f"{saved.path}: holds no plain model to compare with; write it again with "
            "`diffsim diagnose explain` or `extend`"
        )
    return replace(saved, values=saved.plain, parameters=tuple(saved.plain), components=())


def without_values_of(saved: SavedModel, runs: Collection[str]) -> SavedModel:
    """A saved model without what single runs had of their own ("offset@run_9").

    Args:
        runs: Names of runs that the model has not met. A fitted run may have had such a name: its
            clock, its start, ... say nothing of another recording.
    """
    ends = tuple(f"@{name}" for name in runs)

    def others(values: Mapping[str, float]) -> dict[str, float]:
        return {name: value for name, value in values.items() if not name.endswith(ends)}

    return replace(
        saved, values=others(saved.values), sd=others(saved.sd), plain=others(saved.plain)
    )


def rebuilt(saved: SavedModel, setup: DiagnosisSetup) -> ExtendedModel:
    """The saved model, ready to be simulated, differentiated or fitted further.

    Args:
        saved: Content of the file, as ``read_extended`` returns it.
        setup: Plain model and effects by name, made for a study that is framed by the file
            (``SavedModel.framed``), so that sizes mean what they were fitted as. Nuisances of runs
            that the file does not know ("offset@run_9") keep their prior.

    Returns:
        A model whose priors are centered at the saved values.

    Raises:
        ValueError: an effect or parameter that the setup does not have; the message names the
            closest ones. A setup whose causes mean something else.
    """
    _require_frame(saved, setup.model)
    effects = effects_of(saved, setup.effects)
    known = {p.name: p for p in setup.model.base}
    saved = _without_starts_told_anew(saved, known)
    stems = {name.partition("[")[0] for name in known}
    for name in saved.parameters:
        if "[" in name and name.partition("[")[0] in stems:
            continue  # of a rotor, a material, ... that no run of this study has
        if "@" not in name:
            require_choice(f"{saved.path}: parameter", name, known)
    values = {name: p.value for name, p in known.items()} | dict(saved.values)
    sd = {name: p.sd * (p.value if p.log else 1.0) for name, p in known.items()} | dict(saved.sd)
    for effect in effects:
        for name in filter(_is_of_run, effect_coordinates([effect])):
            values.setdefault(name, 0.0)
            sd.setdefault(name, PRIOR_WIDTH * effect.typical)
    _require_units(saved, {**{n: p.unit for n, p in known.items()}, **_units(effects)})
    return extended_at(_prepare_model(setup.model, saved), effects, values, sd, saved.numerics)


def effects_of(saved: SavedModel, candidates: Sequence[Effect]) -> tuple[Effect, ...]:
    """Effects of a saved model, in its order.

    Raises:
        ValueError: an effect that is not among the candidates, or lacks a component.
    """
    numerical = [coarse(name, finer) for name, finer in REFINEMENTS.items()]
    # earlier files have places in small letters
    alike = Counter(e.name.lower() for e in candidates)
    small = {n: replace(e, name=n) for e in candidates if alike[n := e.name.lower()] == 1}
    by_name: dict[str, Effect] = small | {e.name: e for e in (*numerical, *candidates)}
    names = dict.fromkeys(
        c if c in by_name else c.partition(".")[0] for c in saved.components
    )  # "wind.north", or "gain.[propeller=5x4.5]"; an effect with one component its own name
    chosen = []
    for name in names:
        require_choice(f"{saved.path}: effect", name, by_name)
        wanted = effect_coordinates([by_name[name]])
        given = [c for c in saved.components if c == name or c.partition(".")[0] == name]
        # a run that the model has not met tells its own
        if not _have_same_names(wanted, given):
            raise ValueError(
                f"{saved.path}: effect {name} must have {', '.join(wanted)}, got {', '.join(given)}"
            )
        chosen.append(by_name[name])
    return tuple(chosen)


def _have_same_names(wanted: Sequence[str], given: Sequence[str]) -> bool:
    """Whether names of components are the same but for those of single runs ("zero.@run_9")."""
    shared = [sorted(c for c in names if not _is_of_run(c)) for names in (wanted, given)]
    return shared[0] == shared[1] and any(map(_is_of_run, wanted)) == any(map(_is_of_run, given))


def _is_of_run(component: str) -> bool:
    return is_of_run(component.partition(".")[2])


def _require_frame(saved: SavedModel, model: SimModel) -> None:
    made = to_plain(dict(model.frame))
    differing = [k for k, v in to_plain(dict(saved.frame)).items() if k in made and made[k] != v]
    if differing:
        raise ValueError(
            f"{saved.path}: the setup takes its {differing[0]} from other runs than the model was "
            "fitted to, so that sizes mean something else; make it for the framed study, "
            "setup_of(read_extended(path).framed(study))"
        )


def _prepare_model(model: SimModel, saved: SavedModel) -> SimModel:
    if saved.prepared_at is None:
        return model
    at = [float(saved.prepared_at.get(p.name, 0.0)) for p in model.base]
    q = torch.tensor(at, dtype=torch.float64)
    prepared = model.prepared_at(q)
    prepared.prepared_q = q
    return prepared


def _units(effects: Sequence[Effect]) -> dict[str, str]:
    return {c: e.unit for e in effects for c in effect_coordinates([e])}


def _without_starts_told_anew(saved: SavedModel, known: Mapping[str, Parameter]) -> SavedModel:
    """Without what each run has of its own by the study, and all runs had together in the file.

    A start that pieces of one video shared says nothing of a video that begins otherwise.
    """
    own = {name.partition("@")[0] for name in known if "@" in name}
    told = {name for name in saved.parameters if name in own and name not in known}

    def rest(values: Mapping[str, float]) -> dict[str, float]:
        return {name: value for name, value in values.items() if name not in told}

    return replace(
        saved,
        values=rest(saved.values),
        sd=rest(saved.sd),
        parameters=tuple(name for name in saved.parameters if name not in told),
        plain=rest(saved.plain),
        prepared_at=None if saved.prepared_at is None else rest(saved.prepared_at),
    )


def _require_units(saved: SavedModel, units: Mapping[str, str]) -> None:
    for name, unit in saved.units.items():
        if name in units and units[name] != unit:
            raise ValueError(f"{saved.path}: {name} must be in {units[name]}, got {unit}")
