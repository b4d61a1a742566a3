"""Studies of every kind of system with their setups: what a change of causes is held against.

``sources()`` has the published sets, the rigs that are ready, a drawn case without a hidden cause
of every laboratory, the strangers' folders, the sets of ``examples/diagnose``, some of the tests.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from diffsim.cli.arguments import described
from diffsim.cli.diagnose_inputs import own_setup
from diffsim.data.study import Run, Study
from diffsim.data.study_file import READY, load_study
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems import registry

Given = tuple[Study, DiagnosisSetup]
Source = Callable[[], Given]
SEED = 1
PLAIN = "_as_described"  # of cases of an outside simulator: others have the same causes
PULL = {"pull_m": 2e-3 * (1.0 - np.cos(np.pi * np.arange(24) / 6))}
WATER = {"water": {"added_mass": 0.0}, "numerics": {"time_step": "8 ms", "correct_mesh": False}}
#: Studies of tests of kinds and options that nothing else has: module, what makes one of it.
OF_TESTS: Mapping[str, tuple[str, Callable[[Any], Study]]] = {
    "cart": ("toy_cart", lambda m: m.cart_study()),
    "rod": ("rod.test_rod_description", lambda m: m.study()),
    "pendulum": ("outside.scenes", lambda m: m.recorded()),
    "plane_device": (
        "test_flow_description",
        lambda m: replace(m.NetworkLab()(1), system="flow_device", model=m.plane()),
    ),
    "tendon": ("soft_body.described", lambda m: m.study_of(m.TENDON, _pulled(m))),
    "tendon_in_water": (
        "soft_body.described",
        lambda m: m.study_of(m.TENDON, _pulled(m), **WATER),
    ),
    "weight": (
        "soft_body.described",
        lambda m: m.study_of(m.BAR, (m.run_of("a", 0.02 * np.arange(-1, 24), load_kg=0.03),)),
    ),
}
ROOT = Path(__file__).resolve().parents[1]


def sources() -> dict[str, Source]:
    """Makers of all studies by name, in the order in which they are listed."""
    found: dict[str, Source] = {}
    for path in described():
        found[f"published/{path.stem}"] = partial(_read, path)
    for path in sorted(READY.glob("*.yaml")):
        found[f"ready/{path.stem}"] = partial(_ready, path.stem)
    for path in sorted(ROOT.glob("examples/diagnose/*/study.yaml")):
        found[f"example/{path.parent.name}"] = partial(_read, path)
    of_tests = {f"test/{name}": partial(_of_tests, name) for name in OF_TESTS}
    return found | dict(_laboratories()) | dict(_strangers()) | of_tests


def _given(study: Study) -> Given:
    setup = registry.setup_of(study)
    return setup.study or study, setup


def _read(path: Path) -> Given:
    return _given(load_study(path))


def _ready(rig: str) -> Given:
    """A rig that is ready, with a made recording: no study of it has data that may be kept."""
    time = 0.01 * np.arange(400)
    goal = 0.8 * np.sin(2.0 * time) * (time > 0.5)
    table = np.c_[time, goal, np.ones_like(time), np.r_[np.zeros(5), goal[:-5]]]
    content = f"""
name: {rig}
like: {rig}
channels: [{{name: position, column: position_rad, unit: rad, sd: 0.003}}]
commands: [{{name: goal, column: goal_rad}}, {{name: powered, column: powered, unit: "-"}}]
runs:
  - {{name: a, file: a.csv, setup: &rig {{mass_kg: 0.5, arm_m: 0.1, arm_mass_kg: 0.04, kp: 8}}}}
  - {{name: b, file: a.csv, use: test, setup: *rig}}
"""
    with TemporaryDirectory() as folder:
        header = "time_s,goal_rad,powered,position_rad"
        np.savetxt(f"{folder}/a.csv", table, delimiter=",", header=header, comments="")
        (Path(folder) / "study.yaml").write_text(content, encoding="utf-8")
        return _read(Path(folder))


def _laboratories() -> Iterator[tuple[str, Source]]:
    """Of every laboratory and rig one recording in which nothing is hidden."""
    from labs.outside.catalog import CASES
    from labs.rates.domains import DOMAINS, missing_package
    from labs.unlisted.rigs import MACHINES

    for rig in (rig for rigs in DOMAINS.values() for rig in rigs if not missing_package(rig)):
        yield f"rates/{rig.name}", partial(_rig, rig)
    for name, (package, make) in CASES.items():
        if find_spec(package) and name.endswith(PLAIN):
            yield f"outside/{name}", lambda make=make: _given(make(SEED).study)
    for name in MACHINES:
        yield f"unlisted/{name}", partial(_machine, name)


def _rig(rig: Any) -> Given:
    study = rig.record(SEED, {}, "").study
    if rig.setup_file is None:
        return _given(study)
    setup = own_setup(rig.setup_file, study)
    return setup.study or study, setup


def _machine(name: str) -> Given:
    from labs.unlisted.catalog import KINDS
    from labs.unlisted.draw import drawn
    from labs.unlisted.record import STUDY, recorded, write

    kinds = (kind for kind, of_kind in KINDS.items() if name in of_kind.machines)
    cases = (drawn(SEED, kind, turn) for kind in kinds for turn in range(9))
    case = next(case for case in cases if case.machine.name == name)
    with TemporaryDirectory() as folder:
        write(recorded(case, size=0.0), Path(folder))
        return _read(Path(folder) / STUDY)


def _strangers() -> Iterator[tuple[str, Source]]:
    from benchmarks.strangers.__main__ import CASES

    for k, name in enumerate(CASES):
        if (ROOT / f"benchmarks/strangers/{name}.yaml").is_file():
            yield f"stranger/{name}", partial(_stranger, name, k)


def _stranger(name: str, k: int) -> Given:
    with TemporaryDirectory() as folder:
        import_module(f"benchmarks.strangers.{name}").make(Path(folder), np.random.default_rng(k))
        shutil.copy(ROOT / f"benchmarks/strangers/{name}.yaml", f"{folder}/study.yaml")
        return _read(Path(folder))


def _of_tests(name: str) -> Given:
    module, make = OF_TESTS[name]
    return _given(make(import_module(f"tests.systems.{module}")))


def _pulled(described: Any) -> tuple[Run, ...]:
    return (described.run_of("pulled", 0.05 * np.arange(24), command=PULL),)
