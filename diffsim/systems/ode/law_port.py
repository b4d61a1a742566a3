"""Where a law that nobody listed may enter a system of formulas, and on what it may depend."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.expression import Expression, parse_expression, syntax_tree
from diffsim.core.units import NO_UNIT, factor, to_si
from diffsim.data.columns_beside import outputs_of
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.law import (
    FEWEST_VALUES,
    LASTING,
    VALUE,
    Entry,
    Gains,
    HiddenState,
    Law,
    Memory,
    Variable,
    put_variable,
    reading_entries,
)
from diffsim.identify.problem import Problem
from diffsim.identify.setup import LawPort, law_effect
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.ode.applying import entering, symbol
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.network import TIME, Change, filled, named, product
from diffsim.systems.ode.scene import OdeScene, at_start

#: shares of the way that a slipping spring is tried to give way after
GIVING_WAY = (0.03, 0.1, 0.3)
#: periods that hidden masses are tried to swing with, as shares of the longest run: so close that
#: one is within the resonance of a mass that is lightly damped
SWINGING = tuple(0.02 * 8.0 ** (k / 23) for k in range(24))
SLOW_SHARE = 0.5  # of the usual speed of a place, below which it rests
LIGHTLY = 0.05  # damping ratio of a hidden mass that nobody knows

_FLOWS = ("W", "N", "N m", "m^3/s", "kg/s", "A")  # units in which what drives a rate is said
_AT_BOTH = "both"  # entry of a variable that no place alone has
_OWN = "its own"
MOST_LISTED = 3  # names of alike places; of more the first and the last
#: what tells names of alike numbers apart: h1 and h2, k_left and k_right, kpx and kpy
_OWN_PART = re.compile(r"\d+|_[A-Za-z]+$|(?<=[a-z])[A-Zxyz]$")

_HIDDEN = "hidden"  # what a hidden state is called in blocks
_RATE = "hidden_rate"
_LASTING, _REACH, _SWING, _SLOW = "lasting", "slip_reach", "swing_rate", "slow_speed"


@dataclass(frozen=True, eq=False, kw_only=True)
class OdeLaws(LawPort):
    """Entries and variables of a described system."""

    library: Library  # names and usual magnitudes of the described system

    @property
    def entries(self) -> Sequence[Entry]:
        """Places, rates that nothing else tells, numbers, inputs and channels; alike ones at once,
        too."""
        one = tuple(self._list_entries())
        return (*one, *_alike_entries(one, self.library, self._units()))

    def _list_entries(self) -> Iterator[Entry]:
        motion, library = self.library.system.motion, self.library
        places, units = library.places, self._units()
        for place, scale in places:
            yield Entry("force", place.name, place.unit, scale.force)
        mechanical = {n for p, _ in places for n in (p.position, p.velocity)}
        for state, text in motion.rates.items():
            # the rate of a position is a velocity by definition
            if state in mechanical or text.strip() in motion.states:
                continue
            known = units.get(state, NO_UNIT)
            per_second = "1/s" if known == NO_UNIT else to_si(f"{known}/s").unit
            yield Entry("rate", state, per_second, self._usual_rate(state))
        network = self.library.system.network
        formulas = (*network.rates.values(), *network.definitions.values())
        # names that rates, definitions and readings are made of
        used = {n for e in (*formulas, *network.readings.values()) for n in e.names}
        for name, q in self.library.system.keys.parameters.items():
            if name not in used:
                continue
            if q.sd is not None and q.sd >= abs(q.value):  # a share of what may be zero says little
                yield Entry("value", name, q.unit, q.sd)
            elif q.value != 0.0:
                yield Entry("number", name, "-", 1.0)
        for name in self.library.system.held if motion.states else ():
            reach = library.scales.of_commands((name,))["reach"]
            unit = next((c.unit for c in self.study.commands if c.name == name), None)
            yield Entry("input", name, unit or "-", reach)
        yield from reading_entries(self.study)

    def _usual_rate(self, state: str) -> float:
        for store, scale in self.library.stores:
            if store.level == state:
                return scale.rate
        runs = self.study.fit_runs
        channels = [replace(c, sd=1.0) for c in self.study.channels]
        problem = Problem(self.library.model, runs, WhiteNoise(channels))
        found = self.courses(problem, np.zeros(problem.num_base), [Variable(state, state)])
        steps = [np.diff(c[:, 0]) / np.diff(r.time_s) for c, r in zip(found, runs, strict=True)]
        usual = float(np.sqrt(np.mean(np.concatenate(steps) ** 2)))
        return usual if math.isfinite(usual) and usual > 0.0 else 1.0

    def variables(self) -> Sequence[Variable]:
        """What the model knows, what was recorded beside it, and memories of these."""
        plain = tuple(self._list_plain())
        alike = (e for e in self.entries if e.parts)
        own = [v for e in alike for v in _own_variables(e, plain, self.library)]
        apart = (part for v in own for part in v.parts if part.at)
        return (*plain, *apart, *own, *self._list_memories())

    def _list_plain(self) -> Iterator[Variable]:
        motion, runs = self.library.system.motion, self.study.fit_runs
        names = dict.fromkeys(
            (*motion.states, *self.library.system.held, *self.library.system.keys.define)
        )
        units = self._units()
        for name in names:
            yield Variable(name, name, units.get(name, "-"), is_turn=True)
        for channel, text in self.library.system.keys.readings.items():
            if text.strip() not in names:
                yield Variable(channel, f"({text})", units.get(channel, "-"), is_turn=True)
        outputs = outputs_of(self.study) if self.library.system.columns else ()
        for column in (name for name in self.library.system.columns if name not in outputs):
            unit = units.get(column, "-")
            yield Variable(column, column, unit, columns=(column,), is_turn=True)
        if motion.states:
            yield Variable("time", TIME, "s", is_turn=False)
        if len({run.order for run in runs}) >= FEWEST_VALUES:
            yield Variable("order of the runs", "run_order")

    def _units(self) -> dict[str, str]:
        """Units of states, inputs, channels and recorded columns, as far as they are known."""
        out = {c.name: c.unit for c in self.study.channels}
        out |= {c.name: c.unit for c in self.study.commands if c.unit}
        out |= {c.name: c.unit for c in self.study.columns if c.unit}
        for channel, text in self.library.system.keys.readings.items():
            out.setdefault(text.strip(), out[channel])
        for place in self.library.system.motion.places:
            out[place.position] = place.position_unit
            out[place.velocity] = f"{place.position_unit}/s"
        return out

    def _list_memories(self) -> Iterator[Variable]:
        library = self.library
        if not self.library.system.motion.states:
            return
        longest = library.scales.longest_s
        signals = dict.fromkeys((*self.library.system.motion.states, *self.library.system.held))
        for name in signals:
            for share in LASTING:
                time = {_LASTING: share * longest}
                heat = HiddenState(f"(({name})**2 - {_HIDDEN})/{_LASTING}")
                yield _remember("heat", name, f"heat of {name}^2", _HIDDEN, heat, time, "s")
                behind = HiddenState(f"(({name}) - {_HIDDEN})/{_LASTING}", f"({name})")
                lag = f"({name}) - {_HIDDEN}"
                yield _remember("relaxation", name, f"memory of {name}", lag, behind, time, "s")
        for place, scale in library.places:
            v, reach = place.velocity, max(scale.above, scale.below)
            for share in GIVING_WAY:
                slip = HiddenState(f"{v} - abs({v})*{_HIDDEN}/{_REACH}")
                numbers = {_REACH: share * reach}
                unit = place.position_unit
                words = f"spring that slips at {place.name}"
                yield _remember("slip", place.position, words, _HIDDEN, slip, numbers, unit)
            for done, of, words in (
                (f"abs({v})", v, "way gone"),
                (f"abs(({place.position})*{v})", place.position, "work done"),
            ):
                states = {_HIDDEN: HiddenState(done)}
                words = f"{words} at {place.name}"
                yield Variable(words, _HIDDEN, states=states, memory="work", of=of)
            for share in LASTING:
                time = {_LASTING: share * longest}
                rubbed = HiddenState(f"(abs({v}) - {_HIDDEN})/{_LASTING}")
                yield _remember("heat", v, f"heat of |{v}|", _HIDDEN, rubbed, time, "s")
                rested = HiddenState(f"(exp(-({v}/{_SLOW})**2) - {_HIDDEN})/{_LASTING}")
                numbers = {**time, _SLOW: SLOW_SHARE * scale.velocity}
                words = f"rest at {place.name}"
                yield replace(
                    _remember("relaxation", v, words, _HIDDEN, rested, numbers, "s"),
                    number_units={_LASTING: "s", _SLOW: f"{place.position_unit}/s"},
                )
            for share in SWINGING:
                rate = (
                    f"{_SWING}**2*({place.position} - {_HIDDEN})"
                    f" + 2*{LIGHTLY}*{_SWING}*({v} - {_RATE})"
                )
                swing = {
                    _HIDDEN: HiddenState(_RATE, place.position),
                    _RATE: HiddenState(rate, v),
                }
                yield Variable(
                    f"mass that swings at {place.name}",
                    f"{place.position} - {_HIDDEN}",
                    states=swing,
                    memory="oscillator",
                    of=place.position,
                    numbers={_SWING: 2.0 * math.pi / (share * longest)},
                    number_units={_SWING: "rad/s"},
                )

    def drives(self, run: Run, most_knots: int) -> tuple[Effect, ...]:
        """A free course of each rate that is no other state, straight between knots.

        It stands beside all numbers of the model, so that none of them can undo it.
        """
        driven = self._driven_states
        if not driven:
            return ()
        from diffsim.systems.ode.unknown import apply_knots  # of no use on a bench

        count = min(most_knots // len(driven), max(len(run.time_s) // 2, 2))
        spacing = float(run.time_s[-1] - run.time_s[0]) / (count - 1)
        out = []
        for state in driven:
            name = f"course of {state}"
            change = Change(rates={state: named(name)}, inputs={name: False})
            out.append(
                Effect(
                    name=name,
                    family="course",
                    kind="force",
                    unit="1/s",
                    typical=self._usual_rate(state),
                    components=tuple(f"knot_{k}" for k in range(count)),
                    apply=partial(apply_knots, name=name, change=change, spacing=spacing),
                )
            )
        return tuple(out)

    @property
    def _driven_states(self) -> list[str]:
        motion = self.library.system.motion
        return [s for s, text in motion.rates.items() if text.strip() not in motion.states]

    def gains(self, problem: Problem, x: Array, entry: Entry) -> Gains:
        """What a unit at an entry does along the simulation of a problem's one run."""
        probe = "probe of laws"
        zero = {probe: torch.zeros((), dtype=torch.float64)}
        change = self._enter(entry, named(probe), Change())
        scene = self._scene(problem, x, problem.runs[0]).with_change(change, zero)
        with torch.no_grad():
            _, states = scene.solved()
        solver = self.library.system.network.solver(scene.changes)
        ode, times = solver.ode, scene.grid.times
        unit = torch.zeros(len(times), dtype=torch.float64, requires_grad=True)
        values = {TIME: times, **dict(zip(ode.rates, states.unbind(-1), strict=True))}
        drives = {**scene.columns, **scene.inputs}
        values |= {n: drives[p].detach() for n, p in zip(ode.inputs, solver.inputs, strict=True)}
        for name, plain in zip(ode.parameters, solver.parameters, strict=True):
            values[name] = unit if plain == probe else scene.numbers[plain].detach()
        formulas = (
            [ode.rates[s] for s in self._driven_states],
            [ode.readings[c.name] for c in self.study.channels],
        )
        found = [[_slope(f, values, unit) for f in part] for part in formulas]
        at = scene.grid.samples
        rates, readings = (
            torch.stack(part, -1)[at].numpy() if part else np.zeros((len(at), 0)) for part in found
        )
        return Gains(rates, readings)

    def _scene(self, problem: Problem, x: Array, run: Run) -> OdeScene:
        at = torch.from_numpy(np.array(x))
        q = at[: problem.num_base]
        scene = problem.model.scene(run, q, problem.sizes_at(at), problem.numerics)
        assert isinstance(scene, OdeScene)
        return scene

    def courses(self, problem: Problem, x: Array, variables: Sequence[Variable]) -> list[Array]:
        """Variables as a problem simulates them, (num_samples, num_variables) for each run."""
        network = self.library.system.network
        out = []
        for run in problem.runs:
            scene = self._scene(problem, x, run)
            readings = {}
            for k, variable in enumerate(variables):
                change, value = self._read(variable, f"watched {k}")
                scene = scene.with_change(change, self._numbers(variable, f"watched {k}"))
                readings[f"watched {k}"] = value
            watching = network.with_readings({**network.readings, **readings})
            with torch.no_grad():
                found, _ = scene.solved(watching)
            seen = found.index_select(-2, scene.grid.samples)[..., len(network.readings) :]
            out.append(seen.numpy().reshape(len(scene.grid.samples), len(readings)))
        return out

    def terms(
        self, entry: Entry, variable: Variable, terms: Sequence[str], name: str, typical: float
    ) -> Effect:
        """An effect whose components are the factors of terms of a variable."""
        symbols = [f"{symbol(name)} {k}" for k in range(len(terms))]
        change = Change()
        each = variable.at_parts(entry) if entry.parts else ((entry, variable),)
        for part, own in each:
            read, value = self._read(own, name)
            change = replace(read, rates=change.rates, names=change.names, readings=change.readings)
            total = parse_expression("0")
            for text, size in zip(terms, symbols, strict=True):
                term = filled(parse_expression(text, (VALUE,)), {VALUE: value})
                parts = {"before": total, "factor": named(size), "term": term}
                total = filled(parse_expression("before + factor*term"), parts)
            if own.times is not None:
                factor_text = own.times.formula
                total = product(total, parse_expression(factor_text, self._names_for(own)))
            change = self._enter(part, total, change)
        apply = partial(
            _apply_terms,
            change=change,
            symbols=tuple(symbols),
            numbers=self._numbers(variable, name),
        )
        return law_effect(name, entry, len(terms), typical, apply)

    def _numbers(self, variable: Variable, name: str) -> dict[str, Tensor]:
        return {
            f"{n} of {name}": torch.tensor(v, dtype=torch.float64)
            for n, v in variable.numbers.items()
        }

    def _read(self, variable: Variable, name: str) -> tuple[Change, Expression]:
        """The change that hidden states make, and the variable's formula beside it."""
        states = {s: f"{s} of {name}" for s in variable.states}
        own = states | {n: f"{n} of {name}" for n in variable.numbers}
        known = (*self._names_for(variable), *own)
        parts = {short: named(full) for short, full in own.items()}
        rates = {
            states[s]: filled(parse_expression(h.rate, known), parts)
            for s, h in variable.states.items()
        }
        starts = {
            states[s]: self._start(parse_expression(h.start, known), parts)
            for s, h in variable.states.items()
        }
        columns = {n: self.library.system.columns[n] for n in variable.columns}
        change = Change(states=rates, starts=starts, inputs=columns)
        return change, filled(parse_expression(variable.formula, known), parts)

    def _names_for(self, variable: Variable) -> tuple[str, ...]:
        return (*self.library.system.known, *variable.columns)

    def _start(self, formula: Expression, parts: Mapping[str, Expression]) -> Expression:
        begins = {s: named(at_start(s)) for s in self.library.system.motion.states}
        return filled(formula, {**parts, **begins})

    def _enter(self, entry: Entry, total: Expression, change: Change) -> Change:
        """The term added where it enters."""
        if entry.per:
            per = parse_expression(entry.per, self.library.system.known)
            total = filled(parse_expression("flow/per"), {"flow": total, "per": per})
        made = entering(self.library.system, entry.kind, entry.target, total)
        return replace(
            change,
            rates={**change.rates, **made.rates},
            names={**change.names, **made.names},
            readings={**change.readings, **made.readings},
        )

    def action(self, law: Law) -> Mapping[str, Any]:
        """What a law changes, in the keys of a cause of formulas."""
        entry, variable = law.entry, law.variable
        states = {s: {"rate": h.rate, "start": h.start} for s, h in variable.states.items()}
        term = put_variable(law.term, variable)
        if entry.parts:
            added = {}
            for part, own in variable.at_parts(entry):
                one = self.action(replace(law, entry=part, variable=own))
                if "multiplies" in one:
                    added[part.target] = f"{part.target}*({one['term']} - 1)"
                else:
                    added[one["adds_to"]] = one["term"]
            return {"adds": added, "states": states}
        target = {"adds_to": entry.target}
        if entry.per:
            term = f"({term})/({entry.per})"
        elif entry.kind == "force":
            place = next(p for p, _ in self.library.places if p.name == entry.target)
            if place.force is None:
                target = {"adds_to": place.velocity}
                term = f"({term})/({place.inertia})"
            else:
                target = {"adds_to": place.force}
        elif entry.kind == "number":
            target, term = {"multiplies": entry.target}, f"1 + ({term})"
        return {**target, "term": term, "states": states}


def _alike_entries(
    entries: Sequence[Entry], library: Library, units: Mapping[str, str]
) -> Iterator[Entry]:
    """One entry for each group of alike ones, at all of which one law may act: zones, joints.

    What radiates, sags or rubs in one of them mostly does so in all, each by its own value. Tried
    at one place alone, such a law explains a part, and the parts are found one by one or not at
    all.

    Args:
        units: Units of states, by name.
    """
    groups: dict[tuple[str, ...], list[Entry]] = {}
    for entry in entries:
        if entry.kind == "rate" and (unit := units.get(entry.target, NO_UNIT)) != NO_UNIT:
            flow = _as_flow(entry, library, unit)
            groups.setdefault((entry.kind, unit, flow.unit), []).append(flow)
        elif entry.kind == "force":
            place = next(p for p, _ in library.places if p.name == entry.target)
            groups.setdefault((entry.kind, entry.unit, place.position_unit), []).append(entry)
        elif entry.kind == "number" and (stem := _OWN_PART.sub("#", entry.target)) != entry.target:
            said = library.system.keys.parameters[entry.target].unit
            groups.setdefault((entry.kind, said, stem), []).append(entry)
        elif entry.kind in ("input", "reading") and entry.unit != NO_UNIT:
            groups.setdefault((entry.kind, entry.unit), []).append(entry)
    for parts in groups.values():
        if len(parts) > 1:
            targets = [part.target for part in parts]
            is_row = len(targets) > MOST_LISTED
            listed = f"{targets[0]} to {targets[-1]}" if is_row else " and ".join(targets)
            scale = float(np.sqrt(np.mean([part.scale**2 for part in parts])))
            yield Entry(
                parts[0].kind, f"each of {listed}", parts[0].unit, scale, parts=tuple(parts)
            )


def _own_variables(
    entry: Entry, variables: Iterable[Variable], library: Library
) -> Iterator[Variable]:
    """What a law at alike entries may depend on that is another one at each: its own value; of two
    that are driven, how far it lies below the other's, as of a leak or a spring between them.

    Args:
        variables: Those that are the same everywhere.
    """
    plain = {v.formula: v for v in variables if not v.memory}
    places = {place.name: place for place, _ in library.places}
    read = library.system.keys.readings
    kinds = {"force": ("position", "speed"), "number": ()}
    for what in kinds.get(entry.kind, ("value",)):
        found = []
        for part in entry.parts:
            if entry.kind == "force":
                place = places[part.target]
                formula = place.position if what == "position" else place.velocity
            elif entry.kind == "reading":
                formula = read[part.target].strip()
            else:
                formula = part.target
            found += [v for key in (formula, f"({formula})") if (v := plain.get(key))]
        if len(found) == len(entry.parts):
            own = replace(found[0], name=f"{_OWN} {what}", at=(entry.words,), is_turn=False)
            yield replace(own, parts=tuple(found))
            if len(found) == 2 and entry.kind in ("rate", "force"):
                apart = tuple(_apart(v, of) for v, of in (found, found[::-1]))
                yield replace(own, name=f"{_OWN} {what} below the other's", parts=apart)


def _apart(own: Variable, other: Variable) -> Variable:
    """How far a variable lies below another one; for laws at both of their places alone."""
    formula = f"({other.formula}) - ({own.formula})"
    return replace(
        own, name=f"{own.name} below {other.name}", formula=formula, at=(_AT_BOTH,), is_turn=False
    )


def _as_flow(entry: Entry, library: Library, unit: str) -> Entry:
    """What drives a rate, before a constant divides it, such as the heat into a zone."""
    system = library.system
    try:
        root = syntax_tree(system.motion.rates[entry.target].strip())
    except (SyntaxError, ValueError):  # written over several lines
        return entry
    if not (isinstance(root, ast.BinOp) and isinstance(root.op, ast.Div)):
        return entry
    per = ast.unparse(root.right)
    formula, numbers = parse_expression(per), system.keys.parameters
    if not formula.names or not {*formula.names} <= {*numbers}:
        return entry
    size = formula.on_floats(*formula.names)(*(numbers[n].value for n in formula.names))
    if not (math.isfinite(size) and size):
        return entry
    said = numbers[per].unit if per in numbers else NO_UNIT
    return replace(entry, per=per, scale=entry.scale * abs(size), unit=_flow_unit(said, unit))


def _flow_unit(per: str, unit: str) -> str:
    """Unit of what a constant divides to give a rate; none where it is none of the usual ones."""
    if per == NO_UNIT:
        return NO_UNIT
    for flow in _FLOWS:
        try:
            if math.isclose(factor(f"({per})*{unit}/s", flow), 1.0):
                return flow
        except ValueError:
            continue
    return NO_UNIT


def _apply_terms(
    scene: OdeScene,
    size: Tensor,
    run: Run,
    *,
    change: Change,
    symbols: Sequence[str],
    numbers: Mapping[str, Tensor],
) -> OdeScene:
    sizes = {s: size[..., i] for i, s in enumerate(symbols)}
    return scene.with_change(change, {**sizes, **numbers})


def _slope(formula: Expression | str, values: Mapping[str, Tensor], by: Tensor) -> Tensor:
    """Slope of a formula along a simulation, sample by sample."""
    assert isinstance(formula, Expression)
    total = formula(values).sum()
    if not total.requires_grad:
        return torch.zeros_like(by)
    (slope,) = torch.autograd.grad(total, by, allow_unused=True)
    return torch.zeros_like(by) if slope is None else torch.nan_to_num(slope)


def _remember(
    kind: Memory,
    of: str,
    words: str,
    formula: str,
    state: HiddenState,
    numbers: Mapping[str, float],
    unit: str,
) -> Variable:
    return Variable(
        words,
        formula,
        states={_HIDDEN: state},
        memory=kind,
        of=of,
        numbers=numbers,
        number_units=dict.fromkeys(numbers, unit),
    )
