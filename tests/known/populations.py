"""Whole populations by name, each of which gives named numbers.

Public calls, causes of all kinds of systems, environments, designs, devices, and what commands of
the shell say and write.
"""

import io
import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
import trimesh
import yaml

from diffsim import cli, copter, envs
from diffsim.data import save_study
from diffsim.data.study import Study
from diffsim.identify import Numerics, Problem, WhiteNoise
from diffsim.stokes import devices
from tests.cli.test_diagnose_faults import STUDY as FAULTS
from tests.cli.test_diagnose_faults import write as write_day
from tests.cli.test_diagnose_task import TASK
from tests.derivatives import models  # noqa: F401 fills the tables
from tests.derivatives.check import rows
from tests.envs.cases import OPTIONS, STEPS
from tests.known.answers import ANSWERS
from tests.known.cases import CASES
from tests.known.fingerprint import numbers_in
from tests.known.pages import parts_of_page
from tests.known.records import RECORDS
from tests.known.shown import SHOWN
from tests.known.studies import STUDIES
from tests.studies import HERE, NAMES, study_of
from tests.systems.kinds import SHARE, Ready, uniform
from tests.systems.late_cart import fitted_cart
from tests.test_derivatives import PUBLIC, example_of, needs_example
from tests.test_ranges import refused_ranges

WRITTEN = (
    "*.csv",
    "*.html",
    "*.json",
    "*.yaml",
    "*.xml",
    "*.sdf",
    "*.svg",
    "*.obj",
    "*.txt",
    "*.stl",
)
TIMES = re.compile(r"\b\d[\d.]* (?:ms|s|min)\b(?= (?:of|since|so far))|, \d[\d.]* s(?=[,\n])")


FEW = 4  # causes beside base parameters


class Answers(NamedTuple):
    """A population."""

    make: Callable[[Path], Mapping[str, Any]]  # gives named values, in a folder of its own
    share: float = 1e-7  # by which each value may differ between machines, of its array's largest


def public_calls(room: str) -> Callable[[Path], Mapping[str, Any]]:
    """What all that is public in a room and takes tensors gives of its example."""

    def make(folder: Path) -> dict[str, Any]:
        asked = [p for p in PUBLIC if needs_example(p) and p.name.split(".")[1] == room]
        out = {}
        with chdir(folder), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for public in asked:
                function, given = example_of(public)
                out[public.name] = rows(function(given))
        return out

    return make


_last_ready: dict[Callable[[Path], Study], Ready] = {}


def ready_of(study: Callable[[Path], Study], folder: Path) -> Ready:
    """A study and its setup; what its causes have simulated serves its slopes."""
    if study not in _last_ready:
        _last_ready.clear()
        _last_ready[study] = Ready(study(folder))
    return _last_ready[study]


def causes_of(study: Callable[[Path], Study]) -> Callable[[Path], Mapping[str, Any]]:
    """Channels of a study without a cause, and what each cause changes at a share of its size."""

    def make(folder: Path) -> dict[str, Any]:
        ready = ready_of(study, folder)
        out: dict[str, Any] = {"plain": ready.plain}
        for effect in ready.effects.values():
            found = ready.shown(ready.run, {effect: uniform(effect, SHARE)})
            facts = [effect.typical, effect.unit, effect.family, effect.kind, effect.components]
            out[effect.name] = [facts, found - ready.plain[0]]
        base = ready.setup.model.base
        out["base"] = [(p.name, p.value, p.sd, p.lower, p.upper, p.step) for p in base]
        out["unknowns"] = [
            {k: v for k, v in vars(u).items() if isinstance(v, (str, float, int))}
            for u in ready.setup.unknowns
        ]
        return out

    return make


def slopes_of(study: Callable[[Path], Study]) -> Callable[[Path], Mapping[str, Any]]:
    """What a fit, a page and a search for laws ask of a study: columns and gradient of a problem
    with a few causes, unknown ones among them, shapes in space, variables and courses of laws."""

    def make(folder: Path) -> dict[str, Any]:
        ready = ready_of(study, folder)
        setup, run = ready.setup, ready.run
        smooth = tuple(e for e in setup.effects if e.smooth)[:FEW]
        asked = Problem(setup.model, (run,), WhiteNoise(ready.channels), smooth)
        plain, x = replace(asked, effects=()), np.full(len(asked.names), SHARE)
        at, q = x[: asked.num_base], setup.model.at_prior()
        out: dict[str, Any] = {"slopes": asked.linearize(x)}
        out["costs"] = [
            setup.model.cost(r, Numerics(time_step=t, mesh=m))
            for r in ready.cut.runs[:2]
            for t, m in ((1.0, 1.0), (0.5, 1.0), (1.0, 0.5))
        ]
        if ready.study.model["system"] != "outside":  # which has none but differences
            out["gradient"] = asked.gradient(x)
        for unknown in setup.unknowns:
            out[f"unknown {unknown.name}"] = unknown.slopes(plain, at)
        measured = torch.from_numpy(run.measured)
        shapes = (setup.model.shape_at(run, q), setup.model.shape_of(run, measured))
        out["shapes"] = [vars(shape) for shape in shapes if shape is not None]
        if setup.bank:
            out["bank"] = [[r.name, r.time_s, r.measured, r.command, r.setup] for r in setup.bank]
        if (laws := setup.laws) is not None:
            # alike places one by one: all at once are in tests/diagnose/discover/test_alike.py
            entries = [entry for entry in laws.entries if not entry.parts]
            known = [variable for variable in laws.variables() if not variable.parts]
            out["entries"] = entries
            out["variables"] = [[v.name, v.formula, v.unit, v.at, v.numbers] for v in known]
            at_once = [v for v in known if not v.memory][-2 * FEW :]
            out["courses"] = laws.courses(plain, at, [*at_once, *known[-FEW:]])
            gains = (laws.gains(plain, at, entry) for entry in entries[: 2 * FEW])
            out["gains"] = [[g.rates, g.readings] for g in gains if g is not None]
        return out

    return make


def steps_of(name: str) -> Callable[[Path], Mapping[str, Any]]:
    """Observations and rewards of a task under random actions."""

    def make(_: Path) -> dict[str, Any]:
        task = envs.make_task(name, **OPTIONS[name])
        env = gymnasium.make(f"diffsim/{name}-v0", **OPTIONS[name])
        random = np.random.default_rng(0)
        out = {"reset": env.reset(seed=3)[0]}
        for k in range(STEPS):
            action = random.uniform(-1.0, 1.0, task.num_actions).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            out[f"step {k}"] = observation
            out[f"reward {k}"] = [reward, terminated, truncated, _numbers_of(info)]
        return out

    return make


def _numbers_of(info: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in info.items() if isinstance(v, (bool, int, float, np.ndarray))}


def design_of(name: str) -> Callable[[Path], Mapping[str, Any]]:
    """Mass, rotors, hover and stability of a shipped design, and its plan on paper."""

    def make(folder: Path) -> dict[str, Any]:
        design = copter.load_design(name)
        vehicle = design.multicopter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hover = copter.hover(vehicle)
            model = copter.linearize(vehicle, hover.thrusts, hover.attitude)
        return {
            "values": [design.values, design.lower, design.upper],
            "vehicle": rows(vehicle),
            "hover": rows(hover),
            "linearized": rows(model),
            "margins": [
                copter.rotor_out_margins(vehicle),
                copter.min_clearance(vehicle),
                copter.max_hover_weight(vehicle),
                copter.controllability(model.A, model.B),
            ],
        }

    return make


def device_of(name: str) -> Callable[[Path], Mapping[str, Any]]:
    """Flow, loss and its gradient of a device on a coarse grid."""

    def make(_: Path) -> dict[str, Any]:
        device = devices.make(name, resolution=0.2)
        x = (0.4 * device.lower + 0.6 * device.upper).requires_grad_()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loss = device.loss(x)
            (slope,) = torch.autograd.grad(loss, x)
        return {"loss": loss, "slope": slope, "bounds": [device.lower, device.upper]}

    return make


def shell(prepare: Callable[[Path], None], *commands: str) -> Callable[[Path], Mapping[str, Any]]:
    """Numbers that commands say, and of the files that they write."""

    def make(folder: Path) -> dict[str, Any]:
        with chdir(folder):
            prepare(folder)
            known = {path for path, _ in _files(folder)}
            out: dict[str, Any] = {}
            for command in commands:
                said, aside = io.StringIO(), io.StringIO()
                with redirect_stdout(said), redirect_stderr(aside):
                    status = cli.main(command.split())
                text = said.getvalue().replace(str(folder), "")
                out[command] = [status, numbers_in(TIMES.sub("", text))]
            for path, name in _files(folder):
                if path not in known:
                    out |= {f"{name} {part}".strip(): v for part, v in _read(path).items()}
        return out

    return make


def _files(folder: Path) -> list[tuple[Path, str]]:
    found = sorted(path for like in WRITTEN for path in folder.rglob(like))
    return [(path, str(path.relative_to(folder))) for path in found]


def _read(path: Path) -> dict[str, Any]:
    """Parts of a file that was written, without times and sentences."""
    if path.suffix == ".json":
        content = json.loads(path.read_text("utf-8"))
        return dict(_told(content)) if isinstance(content, dict) else {"": _told_value(content)}
    if path.suffix == ".yaml":
        return dict(_told(yaml.safe_load(path.read_text("utf-8")) or {}))
    if path.suffix == ".html":
        return dict(parts_of_page(TIMES.sub("", path.read_text("utf-8"))))
    if path.suffix == ".stl":
        return {"": np.asarray(trimesh.load_mesh(path).triangles)}
    return {"": numbers_in(TIMES.sub("", path.read_text("utf-8")))}


CLOCK = re.compile(r"seconds|elapsed|date|commit|version|machine|path|cpu|folder|^code$")


def _told(content: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if not CLOCK.search(str(key)):
            yield str(key), _told_value(value)


def _told_value(value: Any) -> Any:
    """Numbers and single words; sentences are left to those who write them."""
    if isinstance(value, Mapping):
        return dict(_told(value))
    if isinstance(value, list):
        return [_told_value(part) for part in value]
    if isinstance(value, str):
        return value if re.fullmatch(r"\w+", value) else numbers_in(value)
    return value


def bent_bench(folder: Path) -> None:
    """A bench whose readings bend, which nobody modelled."""
    study = study_of("bench")
    bent = (r.measured + 0.2 * np.abs(r.measured) for r in study.runs)
    runs = tuple(replace(r, measured=m) for r, m in zip(study.runs, bent, strict=True))
    save_study(replace(study, runs=runs), folder / "study")


def late_cart(folder: Path) -> None:
    """A fitted cart and a task."""
    (folder / "out").mkdir()
    save_study(fitted_cart(folder / "out")[0], folder / "study")
    (folder / "task.yaml").write_text(TASK, "utf-8")


def faulty_rig(folder: Path) -> None:
    """Days of a rig, two of which are at fault, and new ones."""
    random = np.random.default_rng(0)
    for n in range(8):
        write_day(folder / f"sound{n}.csv", random)
    for n in range(2):
        write_day(folder / f"cut{n}.csv", random, (1.2, 1.0))
    (folder / "new").mkdir()
    for name in ("weak", "weaker", "sound"):
        write_day(folder / "new" / f"{name}.csv", random, (1.0 if name == "sound" else 1.25, 1.0))
    (folder / "study.yaml").write_text(FAULTS, "utf-8")


def spoiled_records(folder: Path) -> None:
    """Recordings as programs leave them: wrapped, frozen, doubled, with holes, in other units."""
    (folder / "records").mkdir()
    random = np.random.default_rng(5)
    time = 0.01 * np.arange(400)
    for name, speed in (("slow", 1.0), ("fast", 3.0)):
        u = np.sign(np.sin(speed * time))
        turned = np.cumsum(2.0 * speed * u + 0.1 * random.normal(size=400)) * 0.01
        place = 0.3 * np.sin(speed * time) + 1e-3 * random.normal(size=400)
        force = 5.0 * u + 0.05 * random.normal(size=400)
        force[120:180], place[200:210], place[300] = force[120], np.nan, 9.0
        degrees = (np.rad2deg(turned * 40.0) + 180.0) % 360.0 - 180.0
        stamps = 1000.0 * (time + (time > 2.5) * 0.2)
        columns = np.stack([stamps, u, degrees, 1e3 * place, force], 1)
        head = "t_ms,duty,angle (deg),x [mm],force_N"
        lines = [head, *(",".join(f"{v:.5g}" for v in row) for row in columns)]
        (folder / "records" / f"{name}.csv").write_text("\n".join(lines), "utf-8")


def small_studies(folder: Path) -> None:
    """The studies of ``tests/studies``."""
    shutil.copytree(HERE, folder / "studies", ignore=shutil.ignore_patterns("*.py", "__pycache__"))


def nothing(folder: Path) -> None:
    """Commands that need no file."""


EXPLAINED = ("ball", "flow_levels", "ode_places", "toss")  # in 2 CPU s each, at most
ROOMS = sorted({public.name.split(".")[1] for public in PUBLIC if needs_example(public)})
COMMANDS = {
    "bench": (
        bent_bench,
        "diagnose check study",
        "diagnose fit study --out fit",
        "diagnose explain study --budget quick --out out",
        "diagnose extend study --out out",
        "diagnose judge study --out out",
        "diagnose export study --to yaml --out out",
        "diagnose next study --budget quick --out out",
    ),
    **{
        f"explain {name}": (
            small_studies,
            f"diagnose explain studies/{name} --budget quick --out o",
        )
        for name in EXPLAINED
    },
    "records": (
        spoiled_records,
        "diagnose init records --out first.yaml",
        "diagnose check first.yaml",
        "convert records/slow.csv",
        "convert records/slow.csv again.csv",
    ),
    "task": (
        late_cart,
        "diagnose command study --task task.yaml --out out",
        "diagnose worth study --task task.yaml --out out",
    ),
    "faults": (
        faulty_rig,
        "diagnose faults . --out out",
        "diagnose faults . --out out --new new/weak.csv new/weaker.csv --new new/sound.csv",
    ),
    "copter": (
        nothing,
        "fly pentacopter --seconds 0.5 --payload 0.2 --out fly",
        "fabricate quadcopter --out fabricate",
    ),
    "device": (
        nothing,
        "devices funnel --resolution 0.5 --sample-resolution 0.25 --samples 3 --starts 1 "
        "--evaluations 3 --coarse-evaluations 2 --export --out device",
    ),
}
POPULATIONS: dict[str, Answers] = {
    **{f"public {room}": Answers(public_calls(room)) for room in ROOMS},
    "ranges of arguments": Answers(lambda _: refused_ranges()),
    **{
        f"{what} {name}": answers
        for name, make in ({n: lambda _, n=n: study_of(n) for n in NAMES} | STUDIES).items()
        for what, answers in (
            ("causes", Answers(causes_of(make))),
            ("slopes", Answers(slopes_of(make), 1e-5)),
        )
    },
    **{f"case {name}": Answers(make, 1e-5) for name, make in CASES.items()},
    **{f"answer {name}": Answers(make, 1e-4) for name, make in ANSWERS.items()},
    **{f"shown {name}": Answers(make, 1e-4) for name, make in SHOWN.items()},
    **{f"records {name}": Answers(make) for name, make in RECORDS.items()},
    **{f"task {name}": Answers(steps_of(name)) for name in sorted(OPTIONS)},
    **{f"design {name}": Answers(design_of(name)) for name in copter.shipped_designs()},
    **{f"device {name}": Answers(device_of(name), 1e-5) for name in devices.DEVICES},
    **{f"shell {name}": Answers(shell(*given), 1e-4) for name, given in COMMANDS.items()},
}
