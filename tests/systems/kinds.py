"""The contract of a kind of system: what a study of any kind keeps, whoever wrote the kind.

``check_kind(study)`` checks every statement. Each one is a function of a :class:`Ready`.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from diffsim.causes.catalogue import rows_in_order
from diffsim.causes.channel_groups import channel_groups
from diffsim.causes.listing import PAIR, channel_pairs, command_pairs
from diffsim.causes.plant import IN_TIME, LATE_RECORD, Plant
from diffsim.causes.row import Row
from diffsim.core.units import factor
from diffsim.data import load_study, save_study
from diffsim.data.study import Run, Study
from diffsim.identify import Effect, Numerics, Problem, WhiteNoise, coarse, fit
from diffsim.identify.model import RunPoints, SimModel
from diffsim.identify.model_file import read_extended, rebuilt, save_extended
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.ode.description import OdeDescription
from diffsim.systems.ode.effects import plant_of
from diffsim.systems.ode.library import library_of
from diffsim.systems.ode.names import Reader
from diffsim.systems.registry import description_of, setup_of

SMALL = 1e-9  # added to a number: a leak of 0.01 m^2/(s Pa) is no flow any more
SHARE = 0.3  # of usual sizes: one-sided causes act there, and no delay is a whole sample
ROUNDING = 1e-9  # of a channel [noise sd]
TOGETHER = 8  # causes that are simulated at once where each has its own trace
SEEN = 1e-2  # change of a channel that is something [noise sd]
#: kinds whose own code still lists causes: the rules of the tables say nothing of them
LISTED_BY_CODE = ("multicopter",)
OWN = {
    "command": {"map": "u*(1 + size)"},
    "reading": {"map": "u + size*abs(u)"},
    "clock": {"unit": "s"},
    "number": {},
    "force": {"law": "-size*x*abs(x)"},
}


@dataclass(frozen=True)
class Ready:
    """A study and its setup."""

    study: Study  # as described; its last run is for testing

    @cached_property
    def setup(self) -> DiagnosisSetup:
        return setup_of(self.study)

    @cached_property
    def cut(self) -> Study:
        """The study as the model sees it, such as the flights of its bodies."""
        return self.setup.study or self.study

    @cached_property
    def plant(self) -> Plant | None:
        """What the system tells of itself; None: nothing but laws of formulas."""
        described, known = description_of(self.study), self.study.without_tests()
        if not isinstance(described, OdeDescription):
            return described.plant(known)
        return plant_of(library_of(described._read_model(described.inputs, known, Reader(known))))

    @cached_property
    def effects(self) -> Mapping[str, Effect]:
        return {effect.name: effect for effect in self.setup.effects}

    @property
    def run(self) -> Run:
        return self.cut.runs[0]

    @property
    def channels(self) -> list[Any]:
        return [c if c.sd is not None else replace(c, sd=1.0) for c in self.cut.channels]

    @cached_property
    def noise(self) -> Tensor:
        return torch.tensor([c.sd for c in self.channels], dtype=torch.float64)

    def shown(self, run: Run, sizes: Mapping[Effect, Tensor] | None = None) -> Tensor:
        """Channels of a run at the best guess [noise sd]."""
        model = self.setup.model
        with torch.no_grad():
            return model.predict(run, model.at_prior(), sizes) / self.noise

    @cached_property
    def plain(self) -> list[Tensor]:
        """Channels of all runs without a cause [noise sd]."""
        return [self.shown(run) for run in self.cut.runs]

    def with_own(self, *rows: Mapping[str, Any]) -> Ready:
        """The study with causes of a user."""
        model = {**self.study.model, "effects": {"own": [dict(row) for row in rows]}}
        return Ready(replace(self.study, model=model))


def uniform(effect: Effect, share: float) -> Tensor:
    """The same share of its usual size in every component."""
    return torch.full((len(effect.components),), share * effect.typical, dtype=torch.float64)


def change(found: Tensor, plain: Tensor) -> float:
    return float((found - plain).nan_to_num().abs().max())


def causes_act(ready: Ready, silent: tuple[str, ...] = ()) -> None:
    """A cause is nothing at size 0, and something at its usual size.

    Most are nothing bit for bit; what is read between samples is off by rounding.
    """
    assert len(ready.effects) == len(ready.setup.effects) > 3
    for name, effect in ready.effects.items():
        largest = 0.0  # in the first run that shows it
        for run, before in zip(ready.cut.runs, ready.plain, strict=True):
            none = ready.shown(run, {effect: uniform(effect, 0.0)})
            assert change(none, before) <= ROUNDING, name
            some = ready.shown(run, {effect: uniform(effect, 1.0)})
            assert torch.equal(some.isfinite(), before.isfinite()), name
            largest = max(largest, change(some, before))
            if largest > SEEN:
                break
        assert (largest > SEEN) == (name not in silent), (name, largest)


def ports_act(ready: Ready) -> None:
    """A row of a user acts through every port that the plant has; at size 0 it is nothing."""
    plant = ready.plant
    if plant is None:
        return
    in_time = {"clock"} if plant.is_in_time else set()
    ports = {"reading", *in_time, *(("command",) if plant.commands else ())}
    rows = [{"at": port, **OWN[port]} for port in sorted(ports)]
    ways = itertools.cycle(("scale", "add"))  # a number that is zero is scaled in vain
    numbers = [{"at": "number", way: n} for way, n in zip(ways, plant.numbers, strict=False)]
    rows += [row | ({"typical": SMALL} if "add" in row else {}) for row in numbers]
    rows += [{"at": "force", "of": place, **OWN["force"]} for place in plant.places]
    rows = [{"name": f"own_{i}", "typical": 0.01, **row} for i, row in enumerate(rows)]
    mine = ready.with_own(*rows)
    acts = set()
    for row in rows:
        effect = mine.effects[row["name"]]
        none = mine.shown(mine.run, {effect: uniform(effect, 0.0)})
        assert change(none, ready.plain[0]) <= ROUNDING, row
        if change(mine.shown(mine.run, {effect: uniform(effect, 1.0)}), ready.plain[0]) > 0.0:
            acts.add(row["at"])
    assert acts == {row["at"] for row in rows}


def rows_of_a_user(ready: Ready) -> Iterator[tuple[str, dict[str, Any]]]:
    """A cause of the library by its name, and the row by which a user would say the same."""
    plant, kind = ready.plant, ready.plant.kind
    sensors: dict[str, list[str]] = {}
    for channel in ready.study.channels:
        sensors.setdefault(channel.sensor or "", []).append(channel.name)
    for _, row in rows_in_order(kind):
        if row.name in plant.functions:
            continue  # the system's own code does more than its port
        own = {"at": row.at, "kink": row.said("kink", kind)}
        if row.at == "command" and row.each is None:
            for group in plant.ways:
                if set(group.names) <= set(plant.commands):
                    yield (
                        row.name + group.ending,
                        own | {"map": row.said("map", kind), "of": group.names},
                    )
        elif row.at in ("reading", "clock"):
            # what grows from one channel to the next no user's row can say
            for sensor, names in () if row.name == "bus_age" else sensors.items():
                way = {"map": row.said("map", kind)} if row.at == "reading" else {}
                yield f"{row.name}_of_{sensor}", own | way | {"of": names}
        elif row.at == "number" and row.per is None and row.map is None:
            for ending, of in row.of_parts(plant.parts):
                way = {"add": of.add} if of.add else {"scale": of.scale}
                yield row.name + ending, own | way | {"components": of.components}
        elif row.at == "force":
            for name, place in plant.places.items():
                ending = f"_at_{name}" if place.ending is None else place.ending
                yield row.name + ending, own | {"law": row.said("law", kind), "of": name}


def shapes_of(effect: Effect, row: Mapping[str, Any]) -> dict[str, Any]:
    """Further numbers of a cause, as a user's row with a formula states them."""
    text = row.get("map") or row.get("law") or ""
    if text.isidentifier():
        return {}
    own = {name.partition("_of_")[0]: shape for name, shape in effect.shapes.items()}
    keys = ("value", "sd", "lower", "upper", "unit")
    return {"shapes": {n: {k: getattr(s, k) for k in keys} for n, s in own.items()}}


def rows_are_the_librarys(ready: Ready) -> None:
    """A row of a user does what the library's cause of the same map does."""
    if ready.plant is None or ready.plant.kind in LISTED_BY_CODE:
        return
    pairs = [(name, row) for name, row in rows_of_a_user(ready) if name in ready.effects]
    rows = [
        {"name": f"own_{i}", "typical": 1.0, "unit": its.unit, **row, **shapes_of(its, row)}
        for i, (its, row) in enumerate((ready.effects[name], row) for name, row in pairs)
    ]
    assert rows
    mine = ready.with_own(*rows)
    for (name, _), row in zip(pairs, rows, strict=True):
        its, own = ready.effects[name], mine.effects[row["name"]]
        size = torch.full((len(own.components),), its.typical, dtype=torch.float64)
        wanted = ready.shown(ready.run, {its: uniform(its, 1.0)})
        found = mine.shown(mine.run, {own: size})
        torch.testing.assert_close(
            found, wanted, rtol=1e-12, atol=1e-9, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}"
        )


#: what formulas of rows call, one number at a time
CALLED = {
    **{"sign": np.sign, "abs": abs, "max": max, "min": min, "exp": math.exp},
    "clip": lambda u, low, high: min(max(u, low), high),
}


def by_hand(text: str, u: np.ndarray, times: np.ndarray, names: Mapping[str, float]) -> np.ndarray:
    """What a row writes of signals, (num_times, ...), evaluated by Python number by number."""
    code = compile(text, "row", "eval")
    out = np.empty_like(u)
    for at in np.ndindex(u.shape):
        own = {**CALLED, **names, "u": float(u[at]), "t": float(times[at[0]] - times[0])}
        out[at] = eval(code, own)
    return out


def usual_readings(ready: Ready, names: Sequence[str]) -> dict[str, float]:
    """Usual magnitudes of channels, from what was recorded."""
    known = ready.study.fit_runs
    places = [[c.name for c in ready.study.channels].index(name) for name in names]
    seen = np.vstack([run.measured[:, places] for run in known])
    low, high = np.nanmin(seen, 0), np.nanmax(seen, 0)
    return {
        "middle": float(0.5 * (low.min() + high.max())),
        "width": float(high.max() - low.min()),
        "spread": float((high - low).max()),
        "longest": max(float(run.time_s[-1] - run.time_s[0]) for run in known),
    }


def usual_commands(ready: Ready, names: Sequence[str]) -> dict[str, float]:
    """Usual magnitudes of commands, from what was sent."""
    sent = np.hstack([run.command[name] for run in ready.study.fit_runs for name in names])
    return {"reach": float(np.abs(sent).max()), "width": float(sent.max() - sent.min())}


def read_by_hand(ready: Ready, text: str, found: Tensor, names: Mapping[str, float]) -> Tensor:
    """Channels with a formula in those that a cause has changed [noise sd]."""
    own = changed_channels(ready, found)
    shown = (ready.plain[0] * ready.noise).numpy()
    shown[:, own] = by_hand(text, shown[:, own], ready.run.time_s, names)
    return torch.from_numpy(shown) / ready.noise


def changed_channels(ready: Ready, found: Tensor) -> np.ndarray:
    """Indices of the channels that a cause has changed."""
    differs = found.nan_to_num() != ready.plain[0].nan_to_num()
    return np.flatnonzero(differs.any(0).numpy())


def sent_by_hand(
    ready: Ready, text: str, commands: Sequence[str], names: Mapping[str, float]
) -> Tensor:
    """Channels under commands that a formula has changed before they are sent [noise sd]."""
    run = ready.run
    sent = {n: by_hand(text, np.asarray(run.command[n]), run.time_s, names) for n in commands}
    return ready.shown(replace(run, command={**run.command, **sent}))


def written_formulas(ready: Ready) -> Iterator[tuple[Row, str, Effect]]:
    """Rows of commands and readings that are written as formulas, with what each is a cause of."""
    for _, row in rows_in_order(ready.plant.kind):
        text = row.said("map", ready.plant.kind) or ""
        is_formula = row.at in ("command", "reading") and not text.isidentifier()
        if is_formula and row.name not in ready.plant.functions:
            named = re.compile(f"{row.name}(_of_(?!all_)\\w+)?")
            own = (e for name, e in ready.effects.items() if named.fullmatch(name))
            yield from ((row, text, effect) for effect in own)


def formulas_are_as_written(ready: Ready) -> None:
    """A row that is written as a formula does to readings and commands what Python makes of it,
    and its usual size is what its row says of the recordings."""
    if ready.plant is None or ready.plant.kind in LISTED_BY_CODE:
        return
    ways = {f"_of_{name}": (name,) for name in ready.plant.commands}
    ways |= {way.ending: way.names for way in ready.plant.ways}
    for row, text, effect in written_formulas(ready):
        found = ready.shown(ready.run, {effect: uniform(effect, SHARE)})
        size = {"size": SHARE * effect.typical, **{n: s.value for n, s in row.shapes.items()}}
        if row.at == "reading":
            own = [ready.channels[c].name for c in changed_channels(ready, found)]
            usual = usual_readings(ready, own)
            wanted = read_by_hand(ready, text, found, usual | size)
        else:
            sent = ways[effect.name.removeprefix(row.name)]
            usual = usual_commands(ready, sent)
            wanted = sent_by_hand(ready, text, sent, usual | size)
        torch.testing.assert_close(
            found, wanted, rtol=1e-9, atol=1e-6, equal_nan=True,
            msg=lambda m, n=effect.name: f"{n}: {m}",
        )  # fmt: skip
        typical = eval(str(row.said("typical", ready.plant.kind)), dict(usual))
        assert math.isclose(effect.typical, typical, rel_tol=1e-9), effect.name


def stated_numbers(keys: Any) -> Iterator[dict[str, Any]]:
    """Numbers of a description that have a prior."""
    if isinstance(keys, dict):
        if "value" in keys and {"sd", "percent"} & keys.keys():
            yield keys
        keys = list(keys.values())
    for inner in keys if isinstance(keys, (list, tuple)) else ():
        yield from stated_numbers(inner)


def priors_are_as_stated(ready: Ready) -> None:
    """A number with a prior is a base parameter: as wide, and of the same effect if it is restated.

    One that has percent is positive, and so wide is its logarithm.
    """
    model = ready.setup.model
    for k in range(len(list(stated_numbers(ready.study.model)))):
        keys = deepcopy(dict(ready.study.model))
        stated = list(stated_numbers(keys))[k]
        value, _, unit = str(stated["value"]).partition(" ")
        wide = float(stated["percent"]) / 100.0 if "percent" in stated else float(stated["sd"])
        restated = float(value) * math.exp(wide) if "percent" in stated else float(value) + wide
        stated["value"] = f"{restated!r} {unit}" if unit else restated
        other = Ready(replace(ready.study, model=keys))
        q = torch.tensor(
            [
                was.coordinate_of(now.value)
                for was, now in zip(model.base, other.setup.model.base, strict=True)
            ],
            dtype=torch.float64,
        )
        assert q.any() and torch.allclose(q[q != 0.0], torch.ones(1, dtype=q.dtype)), stated
        with torch.no_grad():
            moved = model.predict(ready.run, q) / ready.noise
        torch.testing.assert_close(
            moved, other.plain[0], rtol=1e-9, atol=2e-3, equal_nan=True,
            msg=lambda m, n=stated: f"{n}: {m}",
        )  # fmt: skip


def named_parts(keys: Any) -> Iterator[tuple[str, list[Any]]]:
    """Lists of parts that have names, and the keys under which they stand."""
    for key, parts in keys.items():
        if isinstance(parts, list) and any("name" in p for p in parts if isinstance(p, dict)):
            yield key, parts


def names_are_used_once(ready: Ready) -> None:
    """Two parts of one name are refused in words."""
    keys = deepcopy(dict(ready.study.model))
    for key, parts in named_parts(keys):
        parts.append(parts[-1])
        with pytest.raises(ValueError, match=f"{key}: the name '.*' is used twice"):
            description_of(replace(ready.study, model=keys))
        parts.pop()


def known_before(ready: Ready) -> tuple[Any, ...]:
    """All that a search starts from: causes with their sizes, priors, scales, effort.

    A test run's own start is no prior of the search: it is fitted to that run after the answer.
    """
    own = tuple(f"@{run.name}" for run in ready.study.test_runs)
    causes = [
        (e.name, e.form, e.family, e.kind, e.unit, e.typical, e.components)
        for e in ready.setup.effects
    ]
    unknowns = [
        {k: np.asarray(v).tolist() for k, v in vars(u).items() if isinstance(v, (str, float, int))}
        for u in ready.setup.unknowns
    ]
    base = [
        (p.name, p.value, p.sd, p.lower, p.upper, p.step)
        for p in ready.setup.model.base
        if not p.name.endswith(own)
    ]
    return causes, unknowns, base, dict(ready.setup.model.frame or {}), ready.setup.settings


def with_holes(values: Any) -> np.ndarray:
    """Every other sample missing."""
    out = np.array(values, dtype=float)
    out[::2] = np.nan
    return out


#: change of commands, of readings, of times
SPOILED = {
    "larger and longer": (lambda v: 10.0 * v, lambda v: 10.0 * v, lambda t: 3.0 * t),
    "negative with holes": (lambda v: -v - 1.0, lambda v: with_holes(-v - 1.0), lambda t: t),
}


def spoiled(study: Study, how: str) -> Study:
    """The study with other values, or times, in its test runs."""
    commands, readings, times = SPOILED[how]

    def changed(run: Run) -> Run:
        if run.use != "test":
            return run
        return replace(
            run,
            time_s=times(np.asarray(run.time_s)),
            command={k: commands(np.asarray(v, dtype=float)) for k, v in run.command.items()},
            measured=readings(run.measured),
        )

    return replace(study, runs=tuple(changed(run) for run in study.runs))


def test_runs_change_nothing(ready: Ready) -> None:
    """What a test run holds changes no cause, prior or scale before the answer is frozen."""
    assert ready.study.test_runs and ready.study.without_tests().runs
    before = known_before(ready)
    assert before[0], "a system without causes would tell nothing"
    for how in SPOILED:
        assert known_before(Ready(spoiled(ready.study, how))) == before, how


def saved_means_the_same(ready: Ready) -> None:
    """A saved study is the same study; a saved model says the same, and means it on new runs."""
    with TemporaryDirectory() as made:
        again = Ready(load_study(save_study(ready.study, Path(made) / "study")))
        assert known_before(again) == known_before(ready)
        assert torch.equal(again.plain[0].nan_to_num(), ready.plain[0].nan_to_num())
        some = next(e for e in ready.setup.effects if e.smooth)
        runs = ready.cut.fit_runs[:1]
        found = fit(ready.setup.model, runs, ready.channels, effects=[some], max_evaluations=1)
        save_extended(found, Path(made) / "model.yaml", study=ready.study, verdict="named")
        saved = read_extended(Path(made) / "model.yaml")
    model = rebuilt(saved, ready.setup)
    with torch.no_grad():
        shown = model.predict(runs[0], model.at_prior())
        wanted = found.problem.predict(runs[0], torch.from_numpy(found.x))
    torch.testing.assert_close(shown / ready.noise, wanted / ready.noise, rtol=1e-9, atol=1e-6)
    like = ready.study.runs[0]
    commands = {name: 1.5 * np.asarray(u) for name, u in like.command.items()}
    new = replace(like, name="new", group="new", use="test", command=commands)
    other = setup_of(replace(ready.study, runs=(replace(new, use="fit"),)))
    with pytest.raises(ValueError, match=r"takes its .* from other runs than the model was fitted"):
        rebuilt(saved, other)  # magnitudes of these commands
    framed = Ready(saved.framed(replace(ready.study, runs=(new,))))
    whole = Ready(replace(ready.study, runs=(*ready.study.runs[:-1], new)))
    run = next(run for run in whole.cut.runs if run.name == "new")
    for name, effect in ready.effects.items():
        same = framed.effects[name]
        # a drift from run to run is as large as runs are many; its size means the same
        assert "drift" in name or same.typical == effect.typical, name
        assert same.components == effect.components or is_of_runs(effect), name
    for names in few_at_once(e for e in ready.setup.effects if not is_of_runs(e)):
        sizes = sized(framed, names, SHARE)
        there = framed.shown(framed.run, sizes)
        here = whole.shown(run, {whole.effects[e.name]: size for e, size in sizes.items()})
        torch.testing.assert_close(
            there, here, rtol=1e-9, atol=1e-9, equal_nan=True, msg=lambda m, n=names: f"{n}: {m}"
        )


def is_of_runs(effect: Effect) -> bool:
    """Whether each run has a size of its own: only the scale of such causes is kept."""
    return effect.components[0].startswith("@")


def few_at_once(effects: Iterable[Effect], count: int = TOGETHER) -> Iterator[list[str]]:
    """Names of causes, some of them together: fewer simulations than one for each."""
    names = [effect.name for effect in effects]
    return (names[k : k + count] for k in range(0, len(names), count))


def sized(ready: Ready, names: Iterable[str], share: float) -> dict[Effect, Tensor]:
    """Causes at the same share of their usual sizes."""
    return {ready.effects[name]: uniform(ready.effects[name], share) for name in names}


def why_not(row: Row, plant: Plant) -> str | None:
    """Why a row of the kind's table is no cause of a system; None: it is one."""
    facts = {name for name, holds in plant.facts.items() if holds}
    if plant.kind in row.not_for:
        return "not for this kind"
    if row.each == PAIR:
        found = (command_pairs if row.at == "command" else channel_pairs)(plant)
        return None if found and not facts & {*row.unless} else "nothing to exchange"
    on_its_way = row.at == "command" or row.each == "command"
    if on_its_way and row.each in (None, "command"):
        of_parts = [
            {
                *facts,
                *g.facts,
                *(("one_sided",) if g.is_one_sided else ()),
            }
            for g in plant.ways
        ]
    elif row.each == "place" or (row.at == "force" and row.name not in plant.functions):
        of_parts = [facts | {*place.facts} for place in plant.places.values()]
    elif row.each == "record":
        return None if plant.record and row.name in plant.record.causes else "no such record"
    elif row.at in ("reading", "clock"):
        groups = channel_groups(plant.channels, late_record=bool(plant.facts.get(LATE_RECORD)))
        of_parts = [
            facts | ({"known_clock"} if group.channels in plant.clocks else set())
            for group in (groups if plant.instruments is None else plant.instruments)
            if row.name in group.causes
        ]
    elif row.at == "store":
        of_parts = [facts] * len(plant.stores)
    else:
        filled = [own for _, own in row.of_parts(plant.parts)]
        of_parts = [facts] * len(filled)
        if row.at == "number" and row.name not in plant.functions:
            numbers = [own.add or own.scale for own in filled]
            if not any({*names} <= {*plant.numbers} for names in numbers):
                return "no such number"
            if row.per is None and all({*names} & {*plant.fitted} for names in numbers):
                return "a base parameter"
            if row.per is not None and plant.sessions is None:
                return "no sessions"
        elif row.at != "command" and row.name not in plant.functions:
            return "no such function"
    if not of_parts:
        return "nothing to act on"
    if row.over_time and IN_TIME not in facts:
        return "not in time"
    missing = [{f for f in row.when if f not in known} for known in of_parts]
    kept = [{f for f in row.unless if f in known} for known in of_parts]
    if all(m or k for m, k in zip(missing, kept, strict=True)):
        return f"when {sorted(missing[0])}, unless {sorted(kept[0])}"
    return None


def rows_are_judged_or_refused(ready: Ready) -> None:
    """Every row of the kind's table is a cause, or there is a reason why it is none.

    What is listed is judged, or a study lacks what it needs, which is said in words.
    """
    for effect in ready.setup.effects:
        lacks = effect.needs(ready.study)
        assert lacks is None or len(lacks) > 5, effect.name
    if ready.plant is None or ready.plant.kind in LISTED_BY_CODE:
        return
    reasons: dict[str, list[str | None]] = {}
    for _, row in rows_in_order(ready.plant.kind):
        reasons.setdefault(row.name, []).append(why_not(row, ready.plant))
    for name, own in reasons.items():
        named = re.compile(re.escape(name) + r"(_\w+)?$")
        listed = [effect for effect in ready.effects if named.match(effect)]
        assert (None in own) == bool(listed), (name, own, listed)


def slopes_are_those_of_differences(ready: Ready) -> None:
    """Columns of base parameters, smooth causes and shapes of causes; gradient of the misfit.

    With all causes of a rod at once a tendon that is not commanded is at the edge of slack, where
    its tension has a kink: there each is taken alone.
    """
    effects = ready.setup.effects
    smooth = tuple(e for e in effects if e.smooth)
    is_pulled = ready.study.model["system"] == "rod"
    first, *others = [(cause,) for cause in smooth] if is_pulled else [smooth]
    _columns_are_slopes(ready, first)
    for causes in others:
        _columns_are_slopes(ready, causes, without_base=True)
    for cause in effects:
        if cause.shapes:
            _columns_are_slopes(ready, (cause,), cause.shapes)


def slopes_at_zero_are_those_of_differences(ready: Ready) -> None:
    """Of smooth causes at the plain model, where every search begins: commands rest there, ends lie
    on edges of cells, and what is clamped is at its clamp.

    The first component of each; from zero upward where a cause has one sign. Where a reading has a
    kink, its slope lies between those of both sides. A flight's windows are not asked: they
    start where Gauss and Newton lead, whose slopes leave out the curvature of what is left, and at
    the plain model much is left (``test_multicopter`` has them where little is).
    """
    if ready.study.model["system"] == "multicopter":
        return
    model, run = ready.setup.model, ready.run
    q, smooth = model.at_prior(), [e for e in ready.setup.effects if e.smooth]
    moves = ready.study.model["system"] == "soft_body" and not ready.study.commands
    seen = torch.from_numpy(np.isfinite(run.measured))
    weights = torch.linspace(-1.0, 1.0, run.measured.size).reshape(run.measured.shape)[seen]
    for effect in smooth[:: 3 if moves else 1]:

        def shown(first: Tensor, effect: Effect = effect) -> Tensor:
            others = torch.zeros(len(effect.components) - 1, dtype=torch.float64)
            out = model.predict(run, q, {effect: torch.cat([first[None], others])})
            return weights * out[seen]

        size = torch.zeros((), dtype=torch.float64, requires_grad=True)
        here = shown(size)
        if not here.requires_grad:  # of another run, or a simulator without derivatives
            continue
        (slope,) = torch.autograd.grad(here.sum(), size)
        sides = []
        with torch.no_grad():
            for share in (1e-3, -1e-3 if effect.signed else 1e-3):
                near, far = (
                    (shown(torch.tensor(k * share * effect.typical)) - here) / (k * share)
                    for k in (1.0, 2.0)
                )
                sides.append(2.0 * near - far)  # without their curvature
        ahead, back = sides
        low, high = (float(f(ahead, back).sum()) for f in (torch.minimum, torch.maximum))
        reach = 1e-3 * float(ahead.abs().sum()) + 1e-9
        found = float(slope) * effect.typical
        assert low - reach <= found <= high + reach, (effect.name, low, found, high)


def _columns_are_slopes(
    ready: Ready,
    causes: Sequence[Effect],
    only: Sequence[str] | None = None,
    without_base: bool = False,
) -> None:
    problem = Problem(ready.setup.model, (ready.run,), WhiteNoise(ready.channels), causes)
    shapes = [problem.names.index(name) for cause in causes for name in cause.shapes]
    x = np.full(len(problem.names), SHARE)
    if only is None:
        x[shapes] = 0.0  # they are taken beside their own cause alone
    residual, columns = problem.linearize(x)
    _, gradient = problem.gradient(x)
    for i, name in enumerate(problem.names):
        is_out = i in shapes if only is None else name not in only
        if is_out or (without_base and i < problem.num_base):
            continue
        step = np.eye(len(x))[i] * 1e-3
        slope = -(problem.residual(x + step) - problem.residual(x - step)) / 2e-3
        assert np.abs(columns[:, i] - slope).max() <= 2e-3 * np.abs(slope).max() + 1e-6, name
        reach = np.linalg.norm(residual) * np.linalg.norm(slope)
        assert abs(gradient[i] + columns[:, i] @ residual) <= 1e-3 * reach + 1e-6, name


def many_points_are_as_one_by_one(ready: Ready) -> None:
    """Several points side by side, in base parameters and in every cause.

    Starts of flights follow by tangents of one point: what is of second order is left out, 28 % of
    the change at most.
    """
    model, base = ready.setup.model, len(ready.setup.model.base)
    is_flown = ready.study.model["system"] == "multicopter"
    q = torch.zeros(3, base, dtype=torch.float64)
    q[1], q[2] = 0.2, -0.1
    for names in few_at_once(ready.setup.effects, 1 if is_flown else TOGETHER):
        sizes = [sized(ready, names, share) for share in (0.0, SHARE, 2.0 * SHARE)]
        with torch.no_grad():
            side_by_side = {e: torch.stack([own[e] for own in sizes]) for e in sizes[0]}
            many = model.predict_many(ready.run, q, side_by_side) / ready.noise
            alone = [ready.plain[0]]  # no size, at the best guess
            for at, own in zip(q[1:], sizes[1:], strict=True):
                alone.append(model.predict(ready.run, at, own) / ready.noise)
        off, moved = (many - torch.stack(alone)).nan_to_num(), (many - many[0]).nan_to_num()
        if is_flown and float(off.norm()) < 0.3 * float(moved.norm()):
            continue
        torch.testing.assert_close(
            many, torch.stack(alone), rtol=1e-7, atol=1e-6, equal_nan=True,
            msg=lambda m, n=names: f"{n}: {m}",
        )  # fmt: skip


def many_runs_are_as_one_by_one(ready: Ready) -> None:
    """Several runs at once, at one point or several, have the bits that each has alone."""
    model = ready.setup.model
    q = torch.tensor([[0.0], [0.2]], dtype=torch.float64).expand(2, len(model.base))
    (names, *_) = [*few_at_once(ready.setup.effects), []]
    sizes = [sized(ready, names, share) for share in (0.0, SHARE)]
    both = {e: torch.stack([own[e] for own in sizes]) for e in sizes[0]}
    runs = ready.cut.runs
    asked = [
        *(RunPoints(run, q[1], sizes[1]) for run in runs),
        *(RunPoints(r, q, both) for r in runs),
    ]
    with torch.no_grad():
        found = model.predict_each(asked)
        alone = [SimModel.predict_each(model, [a])[0] for a in asked]
    for a, several, one in zip(asked, found, alone, strict=True):
        assert torch.equal(several.nan_to_num(), one.nan_to_num()), a.run.name


def numerical_causes_are_shares_of_finer_settings(ready: Ready) -> None:
    """A coarse setting, as a cause, moves channels by its share of what the finer one does."""
    model, q, finer = ready.setup.model, ready.setup.model.at_prior(), Numerics(time_step=0.5)
    cause = coarse("time_step", finer)
    with torch.no_grad():
        plain = model.predict(ready.run, q)
        change_of_all = model.predict(ready.run, q, numerics=finer) - plain
        for share in (0.25, 1.0):
            found = model.predict(ready.run, q, {cause: uniform(cause, share)})
            wanted = plain + share * cause.typical * change_of_all
            torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12, equal_nan=True)


def answers_do_not_depend_on_what_was_asked_before(ready: Ready) -> None:
    """Predictions, slopes and batches have the same bits in whatever order they are asked for."""

    def problem() -> Problem:
        fresh = Ready(ready.study)
        causes = fresh.setup.effects[:: max(1, len(fresh.setup.effects) // 3)][:3]
        runs = fresh.cut.runs[:2]
        return Problem(fresh.setup.model, runs, WhiteNoise(fresh.channels), tuple(causes))

    one, other = problem(), problem()
    rng = np.random.default_rng(0)
    points = np.vstack([np.zeros(len(one.names)), 0.02 * rng.standard_normal((1, len(one.names)))])
    points[:, one.num_base :] = np.abs(points[:, one.num_base :])  # causes may be one-sided
    columns = sorted({0, one.num_base, len(one.names) - 1})
    questions = [(way, r, k) for way in range(3) for r in range(len(one.runs)) for k in range(2)]

    def answer(of: Problem, way: int, run: int, k: int) -> bytes:
        asked = replace(of, runs=(of.runs[run],))
        if way == 0:
            return asked.residual(points[k]).tobytes()
        if way == 1:
            return asked.linearize(points[k], only=columns)[1].tobytes()
        return asked.records(np.roll(points, k, axis=0)[:2]).tobytes()

    def answers(of: Problem, seed: int) -> dict[tuple[int, int, int], bytes]:
        order = np.random.default_rng(seed).permutation(len(questions))
        with torch.no_grad():
            return {questions[i]: answer(of, *questions[i]) for i in order}

    first = answers(one, 1)
    assert len(set(first.values())) > len(first) // 2, "points that answer alike tell nothing"
    assert answers(other, 2) == first
    assert answers(other, 3) == first, "a model that was used answers otherwise"


def clocks_may_begin_at_any_second(ready: Ready) -> None:
    """A recording whose clock begins at another second shows the same, with every cause."""
    later = Ready(replace(ready.study, runs=tuple(map(begun_later, ready.study.runs))))
    assert later.effects.keys() == ready.effects.keys()
    timed = {"gust"}  # swings by the clock: its two sizes hold any phase
    for names in [[], *few_at_once(e for n, e in ready.effects.items() if n not in timed)]:
        for run, same in zip(ready.cut.runs[1:2], later.cut.runs[1:2], strict=True):
            found = later.shown(same, sized(later, names, 0.7))
            wanted = ready.shown(run, sized(ready, names, 0.7))
            # stamps are rounded otherwise; a flight makes 1e-14 s up to 4e-5 noise sd
            near = {"rtol": 1e-6, "atol": 1e-3, "equal_nan": True}
            torch.testing.assert_close(found, wanted, **near, msg=lambda m, of=names: f"{of}: {m}")


def begun_later(run: Run) -> Run:
    """The same recording by a clock that began earlier."""
    return replace(run, time_s=run.time_s + 64.0)


def stated_clocks_are_fitted(ready: Ready) -> None:
    """A stated clock is a number of each run that does what the cause did, and no cause; what no
    channel is called is told."""
    late = [name for name in ready.effects if name.startswith("sensor_delay_of_")]
    if "clocks" not in type(description_of(ready.study)).model_fields or not late:
        return
    cause, (name, *others) = ready.effects[late[0]], [n.split("_of_", 1)[1] for n in late]

    def with_clock(**clocks: Any) -> Ready:
        return Ready(replace(ready.study, model={**ready.study.model, "clocks": clocks}))

    own = with_clock(**{name: {"value": 0, "sd": f"{cause.typical} s", "per": "run"}})
    assert {n.split("_of_", 1)[1] for n in own.effects if n.startswith(late[0][:15])} == {*others}
    q = own.setup.model.at_prior()
    q[[p.name for p in own.setup.model.base].index(f"clock_of_{name}@{own.run.name}")] = SHARE
    with torch.no_grad():
        found = own.setup.model.predict(own.run, q) / own.noise
    wanted = ready.shown(ready.run, {cause: uniform(cause, SHARE)})
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-6, equal_nan=True)
    wrong = with_clock(**{f"{name}x": 0.01}).study
    told = "\n".join(str(problem) for problem in description_of(wrong).problems(wrong))
    assert f"clocks.{name}x: no sensor, kind or channel '{name}x'; did you mean '{name}'" in told


def names_are_spelled_one_way(ready: Ready) -> None:
    """Names, families and units of causes, and the units in which people read sizes."""
    for e in ready.setup.effects:
        assert re.fullmatch(r"[a-z][a-zA-Z0-9_]*", e.name), e.name
        assert re.fullmatch(r"[a-z][a-zA-Z0-9_]*", e.family), e.family
        assert "centre" not in e.name + e.family  # American spelling
        assert not re.search(r"[a-z][0-9]", e.unit), (e.name, e.unit)  # powers with ^: m/s^2
        assert len(set(e.components)) == len(e.components) > 0
        if e.shown_unit is not None and e.shown_times is None:
            assert factor(e.unit, e.shown_unit) > 0.0  # raises where none leads there


def check_kind(study: Study, silent: tuple[str, ...] = ()) -> None:
    """Every statement of the contract, for a study whose last run is for testing.

    Args:
        study: Study with ``model``.
        silent: Causes that it cannot show.
    """
    ready = Ready(study)
    causes_act(ready, silent)
    for statement in STATEMENTS:
        statement(ready)


STATEMENTS = (
    ports_act,
    rows_are_the_librarys,
    formulas_are_as_written,
    priors_are_as_stated,
    names_are_used_once,
    test_runs_change_nothing,
    saved_means_the_same,
    rows_are_judged_or_refused,
    slopes_are_those_of_differences,
    slopes_at_zero_are_those_of_differences,
    many_points_are_as_one_by_one,
    many_runs_are_as_one_by_one,
    answers_do_not_depend_on_what_was_asked_before,
    clocks_may_begin_at_any_second,
    stated_clocks_are_fitted,
    names_are_spelled_one_way,
    numerical_causes_are_shares_of_finer_settings,
)
