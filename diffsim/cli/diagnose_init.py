"""``diffsim diagnose init``: a first study.yaml for a folder of recordings, guesses told."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from diffsim.cli.arguments import described
from diffsim.cli.init_target import require_target
from diffsim.core.check import require_choice
from diffsim.core.figures import counted, list_first
from diffsim.core.files import write_text_atomic
from diffsim.core.schema import Part
from diffsim.core.schema_keys import Key, keys_of
from diffsim.data.facts_beside import passed_by
from diffsim.data.folder_rules import guess_study
from diffsim.data.guess import PIECES, Guess, GuessedColumn, GuessedRun
from diffsim.data.joined_files import Kind
from diffsim.data.study_check import TODO, merge_alike, record_problems
from diffsim.data.study_file import load_study
from diffsim.systems.registry import description_class, known_systems

WIDTH = 96
MANY = 13  # runs, that are one entry where a pattern tells them all
EXAMPLES = {
    "ode": """\
For a cart on a spring that a command `force` pushes, with a channel `position`:
  parameters: {m: {value: 1.2, percent: 3, unit: kg}, c: {value: 0.8, percent: 30}, k: 40 N/m}
  inputs: [force]
  states: {x: "0", v: "0"}
  rates: {x: v, v: (force - c*v - k*x)/m}
  readings: {position: x}
  places: [{name: cart, position: x, velocity: v, inertia: m}]   # where forces may act""",
    "soft_body": """\
For a bar of silicone, clamped at x = 0, whose tip a camera follows, with a channel `tip_z`:
  body: {bar: {size: [100 mm, 30 mm, 30 mm], cells: [6, 2, 2]}}    # or {mesh: part.msh}
  material:
    youngs_modulus: {value: 260 kPa, percent: 30}
    density: {value: 1070, percent: 2}
    rayleigh_beta: {value: 2 ms, percent: 70}
  fixed: [{x: 0 mm}]
  markers: {tip: {at: [100 mm, 15 mm, 15 mm]}}
  channels: {tip_z: {markers: [tip], axis: z}}""",
}
SKIPPED = ("system", "effects", "effort")  # every description has them, and few need them


def init(
    folder: Path,
    out: Path | None = None,
    *,
    system: str | None = None,
    parts: Sequence[str] = (),
    force: bool = False,
) -> Path:
    """Write a first study of a folder; what was guessed is printed and stands in the file.

    Args:
        folder: Folder with the recordings.
        out: File to be written; by default study.yaml in the folder.
        system: Kind of system, one of ``known_systems()``; None: ``outside`` where an MJCF lies in
            the folder, else ``ode``.
        parts: Tables of files that hold several, the record first; empty: as they look.
        force: Replace a file that is there.

    Returns:
        The file written.

    Raises:
        FileExistsError: the file is there, and ``force`` is not given.
        ValueError: nothing in the folder looks like a recording, or no such kind of system.
    """
    if system is not None:
        require_choice("--system", system, known_systems())
    out = require_target(folder, out, force=force)
    guess = guess_study(folder, parts)
    model = _model_beside(folder, out, guess) if system in (None, "outside") else None
    guess.said += passed_by(guess, has_model=model is not None)
    text = study_text(guess, folder, out, system or "ode", model)
    write_text_atomic(out, text)
    for sentence in guess.said:
        print(f"guessed: {sentence}")
    try:
        study = load_study(out)
    except ValueError:
        print(f"{out} was written, but must be mended", file=sys.stderr)
        raise
    print(
        f"wrote {out}: {counted(len(study.runs), 'run')}, {counted(len(study.channels), 'channel')}"
    )
    for line in merge_alike([*record_problems(study)]):
        print(f"record: {line}")
    is_missing = "the model, and " if model is None else ""
    print(f"still to be stated: {is_missing}{len(guess.todo)} more; see {TODO} in the file, or")
    print(f"    diffsim diagnose check {out}")
    return out


def _model_beside(folder: Path, out: Path, guess: Guess) -> Mapping[str, Any] | None:
    """Keys of ``model`` for the MJCF that lies in the folder; what they are is told with the
    guess."""
    from diffsim.systems.outside.mjcf_guess import find_mjcf, find_robot, guess_model

    found = find_mjcf(folder)
    names = ", ".join(path.name for path in found)
    columns = [*guess.those("command"), *guess.those("channel")]
    if len(found) > 1 and (robot := find_robot(folder, [column.name for column in columns])):
        others = list_first([path.name for path in found if path != robot])
        guess.said.append(f"model: {robot.name} by its joints' and actuators' names; not {others}")
        found, names = (robot,), robot.name
    if len(found) > 1:
        guess.todo.append(f"model: which of {names} was recorded; see docs/outside.md, MuJoCo")
    if len(found) != 1:
        return None
    stated = os.path.relpath(found[0].resolve(), out.resolve().parent)
    try:
        made = guess_model(found[0], stated, guess)
    except ImportError:
        guess.todo.append(
            f"model: {names} is an MJCF: pip install mujoco, then init again reads it"
        )
        return None
    except ValueError as error:
        guess.todo.append(f"model: {names} is an MJCF that cannot be read: {error}")
        return None
    guess.said += [f"model: {names}, an MJCF that MuJoCo simulates", *made.said]
    guess.todo += made.todo
    return made.keys


def study_text(
    guess: Guess, folder: Path, out: Path, system: str, model: Mapping[str, Any] | None = None
) -> str:
    """The study as commented YAML.

    Args:
        guess: What the folder seems to hold.
        out: File that the text is for; paths are relative to its folder.
        model: Keys of ``model`` that were guessed; None: none, they are listed.
    """
    lines = [
        f"# A first study of {folder.resolve().name}, guessed from its files.",
        f"# Mend what is wrong, fill in what says {TODO}, then: diffsim diagnose check {out.name}",
        "# All keys: docs/study_keys.md",
        "",
        f"name: {_write_inline(folder.resolve().name)}",
    ]
    relative = os.path.relpath(folder.resolve(), out.resolve().parent)
    if relative != ".":
        lines.append(f"data: {_write_inline(relative)}    # folder of the files")
    lines += [
        "",
        "# The system that was recorded.",
        *(_model(system) if model is None else _guessed_model(model)),
        "",
    ]
    time = guess.time[0] if len(guess.time) == 1 else guess.time
    lines += ["# The clock of the files.", f"time: {_write_inline(time)}", *_formats(guess.kinds)]
    lines += ["", "# What was measured; sd is the noise, guessed from the scatter between samples."]
    channels = [f"  - {_write_inline(_channel(c, guess))}" for c in guess.those("channel")]
    lines += ["channels:", *channels] if channels else ["channels: []"]
    lines += ["", *_commands(guess), "", *_runs(guess)]
    lines += ["", "# `check` repeats these until you take them out.", "todo:"]
    lines += [f"  - {_write_inline(sentence)}" for sentence in guess.todo]
    lines += [] if guess.todo else ["  []"]
    return "\n".join(lines) + "\n"


def _formats(kinds: Sequence[Kind]) -> Iterator[str]:
    """Lines and columns of the files, where they are not as they usually are."""
    forms: list[dict[str, Any]] = []
    for kind in kinds:
        layout = kind.files[0].layout
        form: dict[str, Any] = {"header_line": layout.header_line}
        if layout.first_line > layout.header_line + 1:
            form["first_line"] = layout.first_line
        if not layout.header_line:
            form["columns"] = [c.name for c in layout.columns]
        forms.append({} if form == {"header_line": 1} else form)
    if all(form == forms[0] for form in forms):
        if forms[0]:
            yield f"table: {_write_inline(forms[0])}    # lines of the files, from 1"
        return
    yield "# Lines of the files, from 1 (0: no header), one entry for each file of a run."
    yield "table:"
    yield from (f"  - {_write_inline(form)}" for form in forms)


def _commands(guess: Guess) -> Iterator[str]:
    yield "# What was commanded. lower and upper are what was seen: state what is possible, and"
    yield "# rate (the fastest change per second), so that `next` can propose runs."
    commands = guess.those("command")
    if any("file" in _quantity(c, guess) for c in commands):
        yield "# file: which of the files of a run, in the order of `runs`, has the column."
    if not commands:
        yield "commands: []"
        return
    yield "commands:"
    for c in commands:
        yield f"  - {_write_inline(_command(c, guess))}    # looks commanded {c.why}"


def _runs(guess: Guess) -> Iterator[str]:
    """Runs, each with a line of its own; facts that all share stand in ``defaults``."""
    stated = [c.column for c in guess.those("fact")]
    facts = {c.base: _fact(c.name, c.base, c.unit) for c in stated}
    shared: dict[str, Any] = {"setup": facts} if facts else {}
    if guess.stamps:
        shared["stamps"] = guess.stamps
    if guess.duplicates:
        shared["duplicates"] = guess.duplicates
    if guess.every > 1:
        shared["every"] = guess.every
    if guess.is_late:
        shared["zero_time"] = "start"
    if shared:
        yield "# For all runs; facts of `setup` are columns that are constant in each run."
        yield "defaults:"
        yield from (f"  {key}: {_write_inline(value)}" for key, value in shared.items())
        yield ""
    yield "# use: fit, select (chooses between causes) or test (touched once, at the end)."
    if len(guess.kinds) > 1:
        yield "# file: the files of a run; all but the first are read at the clock of the first."
    yield "runs:"
    if guess.split:
        yield from _split_runs(guess)
    elif len(guess.runs) == 1:
        blocks = {"num": PIECES, "use": {"select": [4], "test": [PIECES]}}
        entry = {**_entry(guess.runs[0]), "blocks": blocks}
        yield f"  - {_write_inline(entry)}    # one long run, cut into six pieces"
    elif entry := _pattern(guess):
        yield f"  - {_write_inline(entry)}    # {{run}}: each of {len(guess.runs)}"
    else:
        yield from (f"  - {_write_inline(_entry(run))}" for run in guess.runs)


def _pattern(guess: Guess) -> dict[str, Any]:
    """Many runs that differ in a word of their files' names, as one entry; empty: in more."""
    files = {tuple(file.replace(run.name, "{run}", 1) for file in run.files) for run in guess.runs}
    is_plain = not any(run.setup or run.repeat_of or run.time for run in guess.runs)
    if len(guess.runs) < MANY or len(files) > 1 or not is_plain:
        return {}
    patterns = list(files.pop())
    found = sorted(guess.folder.glob(patterns[0].replace("{run}", "*")))
    if "{run}" not in patterns[0] or len(found) != len(guess.runs):
        return {}
    entry: dict[str, Any] = {"name": "{run}", "file": patterns if patterns[1:] else patterns[0]}
    uses = {use: [r.name for r in guess.runs if r.use == use] for use in ("select", "test")}
    return {**entry, "use": {use: names for use, names in uses.items() if names}}


def _split_runs(guess: Guess) -> Iterator[str]:
    names = [c.name for c in guess.split]
    for files in dict.fromkeys(run.files for run in guess.runs):
        runs = [run for run in guess.runs if run.files == files]
        entry: dict[str, Any] = {"file": _files(runs[0]), "split": names[0]}
        if len(names) > 1:
            name = " ".join(f"{{{n}}}" for n in names)
            entry = {"name": name, "file": _files(runs[0]), "split": names}
        uses = {u: [r.value for r in runs if r.use == u] for u in ("select", "test")}
        if any(uses.values()):
            entry["use"] = {use: values for use, values in uses.items() if values}
        yield f"  - {_write_inline(entry)}"


def _entry(run: GuessedRun) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": run.name, "file": _files(run)}
    if run.use != "fit":
        entry["use"] = run.use
    if run.repeat_of is not None:
        entry["repeat_of"] = run.repeat_of
    if run.time is not None:
        entry["time"] = run.time
    return {**entry, "setup": run.setup} if run.setup else entry


def _files(run: GuessedRun) -> str | list[str]:
    return list(run.files) if run.files[1:] else run.files[0]


def _channel(c: GuessedColumn, guess: Guess) -> dict[str, Any]:
    return _quantity(c, guess) | ({} if c.sd is None else {"sd": c.sd})


def _command(c: GuessedColumn, guess: Guess) -> dict[str, Any]:
    # with a clock of its own it may begin later and end sooner
    filled = {"fill": c.fill} if c.fill else {}
    if c.is_measured:
        return _quantity(c, guess) | filled | {"is_measured": True}
    ends = {"lower": c.lower, "upper": c.upper} if c.lower != c.upper else {}
    ends["before"] = c.before
    seen = {key: float(f"{v:.4g}") for key, v in ends.items() if v is not None}
    return _quantity(c, guess) | filled | seen


def _quantity(c: GuessedColumn, guess: Guess) -> dict[str, Any]:
    column = {} if c.column.name == c.name else {"column": c.column.name}
    first = next(k for k, kind in enumerate(guess.kinds)
                 if c.column.name in kind.files[0].table.header)  # fmt: skip
    file = {} if c.place == first else {"file": c.place + 1}
    return {"name": c.name, **column, **file, "unit": c.unit}


def _fact(column: str, name: str, unit: str | None) -> Any:
    if column == name and unit is None:
        return "column"
    return {"column": column, **({"unit": unit} if unit else {})}


def _model(system: str) -> Iterator[str]:
    """Keys of the description, those that it needs to be filled in, others as comments."""
    yield "model:"
    yield f"  system: {system}    # one of {', '.join(known_systems())}"
    try:
        description: type[Part] = description_class(system)
    except ImportError:
        yield f"  description: {TODO}"
        return
    worked = [path.stem for path in described() if f"system: {system}\n" in path.read_text("utf-8")]
    if worked:
        yield _cut(f"  # Worked examples: diffsim/systems/published/ {', '.join(worked)} (.yaml)")
    for line in EXAMPLES.get(system, "").splitlines():
        yield f"  # {line}"
    yield from _keys(description, "  ")


def _guessed_model(model: Mapping[str, Any]) -> Iterator[str]:
    """Keys that were guessed; long ones an entry a line."""
    yield "model:"
    for key, value in model.items():
        if isinstance(value, Mapping) and len(_write_inline(value)) > WIDTH - 20:
            yield f"  {key}:"
            yield from (f"    {name}: {_write_inline(own)}" for name, own in value.items())
        else:
            yield f"  {key}: {_write_inline(value)}"


def _keys(part: type[Part], indent: str, skipped: tuple[str, ...] = SKIPPED) -> Iterator[str]:
    keys = [key for key in keys_of(part) if key.name not in skipped]
    for key in keys:
        if key.default is None:
            yield from _write_needed_key(key, indent)
    for key in keys:
        if key.default is not None:
            yield _cut(f"{indent}# {key.name}: {_kind(key)}; {key.meaning}")


def _write_needed_key(key: Key, indent: str) -> Iterator[str]:
    """A key that must be given, its block spelled out where it is one."""
    yield _cut(f"{indent}# {key.meaning}; {key.kind}")
    name = key.parts[0].__name__ if len(key.parts) == 1 else ""
    if name and name != "Quantity" and key.kind in (name, f"list of {name}"):
        inner = list(_keys(key.parts[0], indent + ("    " if name != key.kind else "  "), ()))
        first = next((i for i, line in enumerate(inner) if "#" not in line), None)
        if first is None:  # whichever of its keys suit
            yield f"{indent}{key.name}: {TODO}"
        else:
            yield f"{indent}{key.name}:"
            if name != key.kind:  # its first line begins an entry of the list
                inner[first] = f"{indent}  - {inner[first].lstrip()}"
        yield from inner
    else:
        yield f"{indent}{key.name}: {TODO}"


def _kind(key: Key) -> str:
    return key.kind if key.default == "-" else f"{key.default} ({key.kind})"


def _cut(line: str) -> str:
    return line if len(line) <= WIDTH else line[: WIDTH - 3].rsplit(" ", 1)[0] + " .."


def _write_inline(value: Any) -> str:
    """A value on one line of YAML."""
    style = isinstance(value, (Mapping, list))
    text = yaml.safe_dump(
        value, default_flow_style=style, width=10_000, sort_keys=False, allow_unicode=True
    )
    return str(text).removesuffix("\n").removesuffix("\n...")
