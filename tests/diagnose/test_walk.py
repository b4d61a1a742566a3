"""How far it is from a channel of ``study.yaml`` to its verdict, on a bench: files and functions.

A reader who follows one channel opens each of these files. The limits in ``walk_limits.yaml`` are
what was reached, not what was hoped for, and only fall: who needs one more takes another one out.
The walk ``library`` judges the causes of the library alone, ``laws`` goes as the command line does.
"""

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim.core.version import __version__

LIMITS = yaml.safe_load(Path(__file__).with_name("walk_limits.yaml").read_text(encoding="utf-8"))
WALKS = ("library", "laws")
MOTION = ("contact", "control", "copter", "soft", "stokes")
SYSTEMS_IN_MOTION = (
    "balls",
    "multicopter",
    "outside",
    "rigid_body",
    "rod",
    "soft_body",
    "starfish",
)
PARTS_IN_MOTION = ("event_effects", "mends", "moving", "place_effects", "store_effects", "unknown")

STUDY = """
name: small_bench
model:
  system: bench
  define: {thrust: c*speed**2}
  readings: {thrust_N: thrust}
  parameters: {c: {value: 1.0e-5, percent: 30, per: propeller}}
  laws: [{name: thrust, of: speed, unit: N, per: propeller, sweeps: true}]
  effects: {only: [exponent_of_thrust, zero_of_thrust, growth_of_thrust]}
channels: [{name: thrust_N, unit: N, kind: force, sd: 0.02}]
commands: [{name: speed, unit: rad/s}]
runs:
  - {file: a.csv, use: fit, setup: {propeller: A}}
  - {file: b.csv, use: fit, setup: {propeller: B}}
  - {file: c.csv, use: fit, setup: {propeller: C}}
  - {file: d.csv, use: test, setup: {propeller: A}}
"""

# what an import runs is start-up: it is not on the way of a channel
WALK = """
import json, sys
from cProfile import Profile
from importlib.machinery import SourceFileLoader
from pathlib import Path
import diffsim
from diffsim.data.study_file import load_study
from diffsim.diagnose import diagnose
from diffsim.systems.registry import setup_of

home = str(Path(diffsim.__file__).parent)
watch = Profile(builtins=False)
importing, load = 0, SourceFileLoader.exec_module

def unwatched(loader, module):
    global importing
    watch.disable()
    importing += 1
    try:
        load(loader, module)
    finally:
        importing -= 1
        if not importing:
            watch.enable()

def called():
    codes = {entry.code for entry in watch.getstats() if not isinstance(entry.code, str)}
    return sorted(
        (code.co_filename[len(home) + 1 :], code.co_qualname)
        for code in codes
        if code.co_flags & 1 and not code.co_name.startswith("<")  # no body of a class
        and code.co_filename.startswith(home)
    )

def answer(with_laws):
    setup = setup_of(study)
    return diagnose(
        setup.study or study,
        setup.model,
        setup.effects,
        seed=0,
        unknowns=setup.unknowns,
        settings=setup.settings,
        laws=setup.laws if with_laws else None,
    ).verdict

verdicts, walks = [], {}
SourceFileLoader.exec_module = unwatched
watch.enable()
study = load_study(sys.argv[1])
for name in sys.argv[2:]:  # the second goes on from the first, and takes its way again
    verdicts.append(answer(name == "laws"))
    walks[name] = called()
watch.disable()
SourceFileLoader.exec_module = load
modules = sorted(name for name in sys.modules if name.startswith("diffsim."))
print(json.dumps({"verdicts": verdicts, "walks": walks, "modules": modules}))
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Verdicts, functions that were called, and modules that were loaded in a fresh process."""
    folder, rng = tmp_path_factory.mktemp("bench"), np.random.default_rng(0)
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    speed = np.r_[np.linspace(100.0, 900.0, 18), np.linspace(890.0, 110.0, 18)]
    for name, scale in {"a": 1.0, "b": 1.2, "c": 0.9, "d": 1.0}.items():
        thrust = scale * 1e-5 * speed**2 * (1.0 + 0.1 * np.log(speed / 500.0))
        rows = np.c_[np.arange(len(speed)), speed, thrust + 0.02 * rng.normal(size=len(speed))]
        header = "time_s,speed,thrust_N"
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header=header, comments="")
    command = [sys.executable, "-c", WALK, str(folder), *WALKS]
    out = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(out.stdout.splitlines()[-1])


def counts(called):
    return {"files": len({file for file, _ in called}), "functions": len(called)}


@pytest.mark.cpu(9)  # a whole diagnosis without laws and with them, every call of it counted
@pytest.mark.parametrize("name", WALKS)
def test_the_way_to_a_verdict_is_no_longer_than_it_was(walk, name):
    assert set(walk["verdicts"]) == {"named"}
    reached, limits = counts(walk["walks"][name]), LIMITS[-1][name]
    assert all(reached[what] <= most for what, most in limits.items()), (reached, limits)


def test_limits_only_fall():
    """A higher limit would turn the ratchet back."""
    versions = [entry["version"] for entry in LIMITS]
    assert versions[-1] == __version__, "a release adds what it reached"
    for before, after in pairwise(LIMITS):
        for name in WALKS:
            assert all(after[name][what] <= most for what, most in before[name].items()), after


def test_each_folder_of_the_method_is_passed(walk):
    """Else the walk above were no walk, however short."""
    for name, more in (("library", set()), ("laws", {"discover"})):
        folders = {file.rpartition("/")[0] for file, _ in walk["walks"][name]}
        rooms = {"checks", "search", "judge", "say", *more}
        assert folders > {f"diagnose/{room}" for room in rooms}


def test_no_code_of_motion_is_loaded_for_a_bench(walk):
    moving = {f"diffsim.{room}" for room in MOTION}
    moving |= {f"diffsim.systems.{name}" for name in SYSTEMS_IN_MOTION}
    moving |= {f"diffsim.systems.ode.{name}" for name in PARTS_IN_MOTION}
    assert not moving.intersection(walk["modules"])
