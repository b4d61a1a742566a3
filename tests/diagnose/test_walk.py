"""How far it is from a channel of ``study.yaml`` to its verdict, on a bench: files and functions.

A reader who follows one channel opens each of these files. The limits are what was reached, not
what was hoped for: who needs one more takes another one out. The walk goes as the command line
does: laws that no library holds are looked for, by seven files and 155 functions more (of two
variables by fifteen), and leave the cause of the library its name. Large arrays lie in files by
eight. Propellers are devices of one type: what they share, and in what they differ, is told by
three files and 22 functions.
"""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

MAX_FILES, MAX_FUNCTIONS = 96, 994
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
PARTS_IN_MOTION = ("event_effects", "place_effects", "store_effects", "stepping", "unknown")

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
from pathlib import Path
import diffsim
from diffsim.data.study_file import load_study
from diffsim.diagnose import diagnose
from diffsim.systems.registry import setup_of

home = str(Path(diffsim.__file__).parent)
importing, called = 0, set()

def watch(frame, event, arg):
    global importing
    code = frame.f_code
    if code.co_name == "<module>":
        importing += (event == "call") - (event == "return")
    is_function = code.co_flags & 1 and not code.co_name.startswith("<")  # no body of a class
    if event == "call" and not importing and is_function and code.co_filename.startswith(home):
        called.add((code.co_filename[len(home) + 1 :], code.co_qualname))

sys.setprofile(watch)
study = load_study(sys.argv[1])
setup = setup_of(study)
report = diagnose(
    setup.study or study,
    setup.model,
    setup.effects,
    seed=0,
    unknowns=setup.unknowns,
    settings=setup.settings,
    laws=setup.laws,
)
sys.setprofile(None)
modules = sorted(name for name in sys.modules if name.startswith("diffsim."))
print(json.dumps({"verdict": report.verdict, "called": sorted(called), "modules": modules}))
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Verdict, functions that were called, and modules that were loaded in a fresh process."""
    folder, rng = tmp_path_factory.mktemp("bench"), np.random.default_rng(0)
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    speed = np.r_[np.linspace(100.0, 900.0, 18), np.linspace(890.0, 110.0, 18)]
    for name, scale in {"a": 1.0, "b": 1.2, "c": 0.9, "d": 1.0}.items():
        thrust = scale * 1e-5 * speed**2 * (1.0 + 0.1 * np.log(speed / 500.0))
        rows = np.c_[np.arange(len(speed)), speed, thrust + 0.02 * rng.normal(size=len(speed))]
        header = "time_s,speed,thrust_N"
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header=header, comments="")
    command = [sys.executable, "-c", WALK, str(folder)]
    out = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return json.loads(out.stdout.splitlines()[-1])


@pytest.mark.cpu(9)  # a whole diagnosis, laws too, every call of it counted
def test_the_way_to_a_verdict_is_no_longer_than_it_was(walk):
    assert walk["verdict"] == "named"
    files = {file for file, _ in walk["called"]}
    assert len(files) <= MAX_FILES, sorted(files)
    assert len(walk["called"]) <= MAX_FUNCTIONS, walk["called"]


def test_each_folder_of_the_method_is_passed(walk):
    """Else the walk above were no walk, however short."""
    folders = {file.rpartition("/")[0] for file, _ in walk["called"]}
    assert folders > {
        f"diagnose/{room}" for room in ("checks", "search", "judge", "say", "discover")
    }


def test_no_code_of_motion_is_loaded_for_a_bench(walk):
    moving = {f"diffsim.{room}" for room in MOTION}
    moving |= {f"diffsim.systems.{name}" for name in SYSTEMS_IN_MOTION}
    moving |= {f"diffsim.systems.ode.{name}" for name in PARTS_IN_MOTION}
    assert not moving.intersection(walk["modules"])
