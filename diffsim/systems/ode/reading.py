"""Reads a description: formulas are parsed against a study, mistakes reported, records asked."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from diffsim.causes.channel_groups import channels_of, clock_of
from diffsim.causes.scales import HELD
from diffsim.causes.scene import PLAY_START
from diffsim.core.check import did_you_mean
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.signal import looks_held, moves_on, scatter
from diffsim.data.study import Study
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.ode.described import DescribedMotion, FormulaSystem
from diffsim.systems.ode.keys import FormulaKeys, Input
from diffsim.systems.ode.names import RUN_ORDER, Reader, data_names, fact_names, longest
from diffsim.systems.ode.network import TIME, Network, filled, named, ordered, piecewise
from diffsim.systems.ode.own_effects import own_effect, shape_name
from diffsim.systems.quantities import START_IN_PLAY

LONGEST = "longest"  # place in a study's frame
_WORDS = re.compile(r"\w+")
_NOISE = "_noise"  # after the name of a first sample: how far noise put it off
_SLOW_SHARE = 0.1  # of the longest run: how long a slow share takes, if nobody says


def read_system(
    keys: FormulaKeys,
    given: tuple[Input, ...],
    motion: DescribedMotion,
    study: Study,
    reader: Reader,
) -> FormulaSystem:
    """Parse a description's formulas against a study, and mend its model as the records ask."""
    open_ = {i.name: list_commands_of(i, study) for i in given if i.held is None}
    moving = {name for name, commands in open_.items() if moves_on(study.runs, commands)}
    held = _find_held_inputs(given, moving, study, reader)
    doubtful = {name for name, commands in open_.items() if commands}
    assumed = {name for name in doubtful if held[name]}
    clocks = _list_clocks(motion, study, reader)
    quantities = _list_quantities(keys, given, motion, study)
    facts = fact_names(study)
    _check_names(keys, motion, held, quantities, facts, reader)
    numbers = (*quantities, *facts, *data_names(study, keys.rest))
    between = (*keys.define, *keys.tables)
    known = (TIME, *motion.states, *held, *between, *numbers)
    taken = {*(c.name for c in study.channels), *known}
    used = {command for each in given for command in list_commands_of(each, study)}
    # what nothing uses lies beside, whether the study states it or not
    unused = [c.name for c in study.commands if c.name not in used and _is_whole(c.name, study)]
    beside = [c.name for c in study.columns] + unused
    columns = {
        n: looks_held(study.runs, [n] if n in unused else ())
        for n in beside
        if n.isidentifier() and n not in taken
    }

    def parsed(key: str, formulas: Mapping[str, str]) -> dict[str, Expression]:
        return {n: reader.parse(f"{key}.{n}", f, known) for n, f in formulas.items()}

    starts = {
        state: named(f"{state}_start")
        if isinstance(start, Quantity)
        else _with_noise(reader.parse(f"states.{state}", start, (*numbers, *held)), quantities)
        for state, start in motion.states.items()
    }
    inputs = _parse_inputs(given, numbers, study, reader)
    rates, readings = parsed("rates", motion.rates), parsed("readings", keys.readings)
    define = dict(keys.define)
    if motion.states:
        from diffsim.systems.ode.moving import check_motion
        from diffsim.systems.ode.swings import with_swings

        check_motion(motion, keys, held, known, reader)
        define = with_swings(define, motion.swings)
    every, states = (*known, *columns), tuple(motion.states)
    own = tuple(
        own_effect(f"effects.own[{i}]", block, study, every, columns, states, reader)
        for i, block in enumerate(keys.effects.formulas)
    )
    definitions = parsed("define", define)
    for name, table in keys.tables.items():
        of = reader.parse(f"tables.{name}.of", table.of, known)
        definitions[name] = piecewise(of, table.at, table.values)
    try:
        ordered(definitions)
    except ValueError as error:
        reader.report("define", str(error))
        definitions = {}
    for i, law in enumerate(keys.laws):
        if law.name not in between:
            reader.report(f"laws[{i}].name", f"no definition {law.name!r}; add it to define")
        reader.parse(f"laws[{i}].of", law.of, known)
        reader.require_per(f"laws[{i}]", law.per)
    system = FormulaSystem(
        keys=keys,
        motion=motion,
        study=study,
        held=held,
        unsure=frozenset(doubtful - assumed),
        assumed=frozenset(assumed & moving),
        clocks=clocks,
        known=known,
        columns=columns,
        starts=starts,
        inputs=inputs,
        network=Network(rates, readings, definitions, held, dict(motion.limits)),
        own=own,
        base=BaseParameters({} if reader.has_errors else quantities, study.runs),
    )
    if reader.has_errors or not motion.states:
        return system
    from diffsim.systems.ode.mends import mended

    return mended(system, reader)


def _is_whole(command: str, study: Study) -> bool:
    """Whether each run shows a command at all samples: of one that nothing uses nobody asks it."""
    return all(np.isfinite(run.command.get(command, np.nan)).all() for run in study.runs)


def list_commands_of(given: Input, study: Study) -> list[str]:
    """Commands that an input is made of."""
    words = {given.name} if given.formula is None else set(_WORDS.findall(given.formula))
    return sorted(words & {c for run in study.runs for c in run.command})


def is_held(given: Input, study: Study) -> bool:
    """Whether an input is held: as is stated, else as an earlier fit took it, else as it looks."""
    if given.held is not None:
        return given.held
    kept = study.frame.get(HELD, {}).get(given.name)
    commands = list_commands_of(given, study)
    return looks_held(study.runs, commands) if kept is None else bool(kept)


def _find_held_inputs(
    inputs: Sequence[Input], moving: Collection[str], study: Study, reader: Reader
) -> dict[str, bool]:
    """Inputs, with whether they keep their value until the next sample."""
    out = {given.name: is_held(given, study) for given in inputs}
    for i, given in enumerate(inputs):
        is_seen = given.held is None and given.name not in study.frame.get(HELD, {})
        if is_seen and out[given.name]:
            commands = list_commands_of(given, study)
            cause = "; straight_between_samples is a cause, as some runs do not show it"
            reader.report(
                f"inputs[{i}].held",
                f"{' and '.join(commands)} rests and jumps, so {given.name} is held between "
                "samples; give `held: false` for straight lines"
                + (cause if given.name in moving else ""),
                "note",
            )
    return out


def _parse_inputs(
    inputs: Sequence[Input], numbers: tuple[str, ...], study: Study, reader: Reader
) -> dict[str, Expression]:
    """Formula of every input, in commands, facts and parameters."""
    commands = tuple(dict.fromkeys(c for run in study.runs for c in run.command))
    out = {}
    for i, given in enumerate(inputs):
        key, names = f"inputs[{i}]", (TIME, *commands, *numbers)
        if given.formula is not None:
            out[given.name] = reader.parse(f"{key}.formula", given.formula, names)
            continue
        out[given.name] = named(given.name)
        if given.name not in commands:
            known = ", ".join(commands) or "none"
            hint = did_you_mean(given.name, commands)
            reader.report(key, f"no command {given.name!r}{hint}; the study has {known}")
    for run in study.runs:
        for name in dict.fromkeys(n for e in out.values() for n in e.names):
            if not np.isfinite(run.command.get(name, np.zeros(1))).all():
                reader.report(
                    "inputs",
                    f"run {run.name}: command {name} has empty cells; say what they mean by "
                    "`fill` under commands",
                )
    return out


def _list_quantities(
    keys: FormulaKeys, inputs: Sequence[Input], motion: DescribedMotion, study: Study
) -> dict[str, Quantity]:
    """Parameters, then what states, inputs and effects ask for beside them."""
    given = dict(keys.parameters)
    given |= {f"{s}_start": q for s, q in motion.states.items() if isinstance(q, Quantity)}
    given |= _first_noises(motion, study)
    given |= {f"{i.name}_delay": i.delay for i in inputs if i.delay is not None}
    if motion.states:
        from diffsim.systems.ode.moving import quantities_of_motion

        given |= quantities_of_motion(motion, study)
    given |= {clock_of(name): q for name, q in motion.clocks.items()}
    for block in keys.effects.formulas:
        given |= {shape_name(block, s): q for s, q in block.shapes.items()}
    only = keys.effects.only  # whether a play is among the causes to be judged
    may_have_play = only is None or any(n.startswith(("backlash", "sensor_backlash")) for n in only)
    if motion.states and may_have_play:
        given[PLAY_START] = START_IN_PLAY
    if motion.states and (inputs or motion.places):
        value = _SLOW_SHARE * (study.frame.get(LONGEST) or longest(study.runs))
        usual = Quantity(value=value, percent=100.0, unit="s")
        given.setdefault("slow_time", motion.slow_time or usual.as_usual())
    return given


def _first_noises(motion: DescribedMotion, study: Study) -> dict[str, Quantity]:
    """Noise of the first samples that states start from, one for each run: a start is no better
    known than the sensor knows it."""
    starts = " ".join(s for s in motion.states.values() if not isinstance(s, Quantity))
    words, out = set(_WORDS.findall(starts)), {}
    for at, channel in enumerate(study.channels):
        if f"first_{channel.name}" not in words:
            continue
        sd = channel.sd
        if sd is None:
            seen = [r.measured[np.isfinite(r.measured[:, at]), at] for r in study.runs]
            # samples that tell their noise
            levels = [float(scatter(np.diff(v, 2), 2)) for v in seen if len(v) >= 8]
            sd = float(np.median(levels)) if levels else 0.0
        if sd > 0.0:
            quantity = Quantity(value=0.0, sd=sd, per="run", unit=channel.unit)
            out[f"first_{channel.name}{_NOISE}"] = quantity
    return out


def _with_noise(start: Expression, quantities: Mapping[str, Quantity]) -> Expression:
    """The formula of a start, noise taken off the first samples that it uses."""
    noisy = [name for name in start.names if f"{name}{_NOISE}" in quantities]
    parts = {name: parse_expression(f"{name} - {name}{_NOISE}") for name in noisy}
    return filled(start, parts) if parts else start


def _list_clocks(
    motion: DescribedMotion, study: Study, reader: Reader
) -> dict[str, tuple[str, ...]]:
    """Channels that are late together, by the parameter that says how much."""
    out = {}
    for name in motion.clocks:
        try:
            out[clock_of(name)] = channels_of(study.channels, name)
        except ValueError as error:
            reader.report(f"clocks.{name}", str(error))
    return out


def _check_names(
    keys: FormulaKeys,
    motion: DescribedMotion,
    inputs: Iterable[str],
    quantities: Mapping[str, Quantity],
    facts: Iterable[str],
    reader: Reader,
) -> None:
    states, rates = motion.states, motion.rates
    reader.require_channels(keys)
    reader.require_names(
        {
            "states": states,
            "inputs": inputs,
            "parameters": keys.parameters,
            "define": keys.define,
            "tables": keys.tables,
            "setup of the runs": [f for f in facts if f != RUN_ORDER],
        }
    )
    for name, q in quantities.items():
        reader.require_per(f"parameters.{name}", q.per)
    for name in rates:
        if name not in states:
            reader.report(f"rates.{name}", "no such state; give its start value in states")
    for name in states:
        if name not in rates:
            reader.report("rates", f"state {name} has no rate; add `{name}: ...`")
    for name in motion.limits:
        if name not in states:
            reader.report(f"limits.{name}", "no such state")
