"""Studies beside those of ``tests/studies``, from the rooms' tests: whose causes are known, too."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.data import load_study
from diffsim.data.study import Channel, Run, Study

Make = Callable[[Path], Study]


def of(place: str, **options: Any) -> Make:
    """What a function of a test's module makes, by the names of both."""

    def make(folder: Path) -> Study:
        module, _, name = place.rpartition(".")
        options_here = {k: folder if v is Path else v for k, v in options.items()}
        study: Study = getattr(import_module(f"tests.{module}"), name)(**options_here)
        return study

    return make


def network(kind: str) -> Make:
    """Channels that pumps or regulators drive, through the Stokes simulator."""

    def make(folder: Path) -> Study:
        from tests.systems import test_flow_device as flow

        return flow.study_of(flow.DEVICES[kind])

    return make


def pushed_cart(folder: Path) -> Study:
    """A cart that somebody pushes for a while in one of its runs."""
    from tests.systems import test_ode_events as events

    events._cart(folder, seed=0)
    text = events.STUDY.format(events=events.EVENTS, runs=events.RUNS)
    (folder / "study.yaml").write_text(text, "utf-8")
    return load_study(folder)


def estimated(folder: Path) -> Study:
    """A flight that an estimator shows which knows no drag."""
    from tests.systems import test_estimator as case

    keys = {
        "sensors": {
            "position": ["x", "y", "z"],
            "velocity": ["vx", "vy", "vz"],
            "quaternion": {"columns": ["qw", "qx", "qy", "qz"], "order": "wxyz"},
            "body_rates": ["p", "q", "r"],
        },
        "windows": {"length": 0.4},
        "estimator": {"velocity": case.A, "tilt": case.B, "heading": case.C},
        "effects": {"only": ["rotor_speed_drag", "blind_estimator"]},
    }
    return case.study(kinds=("circle",), **keys)


def published(name: str, **keys: Any) -> Make:
    """A published description of recordings that its test writes into a folder.

    Args:
        name: Of the description; ``tests.systems.published.test_NAME`` writes its files.
        keys: Of the study, in place of those that it states.
    """

    def make(folder: Path) -> Study:
        from tests.systems.published.twins import load_twin, stated_of

        module = import_module(f"tests.systems.published.test_{name}")
        stated = stated_of(name)
        WRITTEN[name](module, folder, stated)
        return load_twin(folder, stated | keys)

    return make


def _write_seals(module: Any, folder: Path, stated: dict[str, Any]) -> None:
    for k, bar in enumerate((1, 3, 5, 7)):
        for j, label in enumerate(module.GROWS):
            module.write_cycles(folder / f"{label}_{bar}bar.csv", bar, label, 10 * k + j)
    stated["runs"] = stated["runs"][:2]


def _write_nano(module: Any, folder: Path, stated: dict[str, Any]) -> None:
    for k, kind in enumerate(("circle", "dash")):
        module.write_flight(folder / f"{kind}.csv", kind, 4.1 - 0.12 * k, k)
    module.describe(stated["model"])


def _write_wind(module: Any, folder: Path, stated: dict[str, Any]) -> None:
    module.write_flight(folder / "flight_01.csv", -6.0, 2.0, 4.4, 1)
    module.write_flight(folder / "flight_02.csv", -6.0, 0.0, 5.0, 3)


WRITTEN: dict[str, Callable[[Any, Path, dict[str, Any]], None]] = {
    "pneumatic_actuator": _write_seals,
    "nanobench": _write_nano,
    "wind_flights": _write_wind,
}
CUT = {"from_s": 0.5, "until_s": 1.5}


def fish(folder: Path) -> Study:
    """A robot fish, filmed by a camera that is fast."""
    from tests.systems.published.test_robot_fish import FAST, write_twin

    return load_study(write_twin(folder, FAST, seconds=1.0))


def swaying(folder: Path) -> Study:
    """A beam on a support that moves, released from a hand."""
    from tests.systems.soft_body.bars import released_bar
    from tests.systems.swaying_lab import GRAVITY, HELD_START, recorded

    body = released_bar(
        cells=(4, 1, 1), dt_s=5e-3, integrator="implicit_midpoint", gravity=GRAVITY
    ) | {
        "channels": {
            "tip_z_m": {
                "markers": ["tip1", "tip2", "tip3"],
                "axis": "z",
                "zero": {"value": 0.0, "sd": 1e-3, "per": "run"},
            }
        },
        "support": {"x": "support_x_m", "z": "support_z_m"},
        "start": HELD_START,
    }
    return replace(recorded(until_s=0.2), model=body)


def hexarotor(folder: Path) -> Study:
    """A hexarotor, with causes of every family, at one rotor alone."""
    from tests.systems import test_hexarotor as case

    few = ["rotor_drag", "body_drag", "parasitic_drag", "wind", "wake", "slung_load", "gyroscopic"]
    few += ["battery_sag", "placement", "camera_delay", "weak_rotor_1", "rotor_tilt_1", "delay"]
    study = case.hexarotor()
    return replace(study, model={**study.model, "effects": {"only": few}})


def starfish(folder: Path) -> Study:
    """A leg that a cable pulls, which may go slack."""
    from tests.systems import slack_starfish as case

    return case.study_of([np.zeros((len(case.T), 1))] * 2)


def chip(folder: Path) -> Study:
    """A network of channels in a plane, simulated as a flow."""
    from tests.systems import test_flow_description as case

    return replace(case.NetworkLab()(1), system="flow_device", model=case.plane(corrected=True))


def meeting(folder: Path) -> Study:
    """A ball that rolls into another one at rest, both followed from above."""
    time, bodies = np.arange(30) / 60.0, ("struck", "coming")
    runs = []
    for k in range(2):
        speed = (1.0 + 0.3 * k) * np.array([1.2, 0.1])
        after = np.maximum(time - 0.3 / np.linalg.norm(speed), 0.0)[:, None]
        struck = np.array([0.36, 0.03]) + 0.8 * after * speed
        coming = (time[:, None] - 0.8 * after) * speed
        high = np.full((len(time), 1), 0.03)
        seen = np.hstack([struck, high, coming, high])
        runs.append(Run(f"r{k}", time, seen, {}, f"r{k}", k))
    ball = {"sphere": "60 mm", "mass": "50 g", "inertia_ratio": 0.5}
    model = {
        "system": "rigid_body",
        "bodies": [
            {"name": "struck", **ball, "begins": "at_rest"},
            {"name": "coming", **ball, "begins": "on_ground"},
        ],
        "contacts": [{"between": bodies, "restitution": {"value": 0.7, "sd": 0.1}}],
        "measures": [{"body": b, "position": {a: f"{b}_{a}" for a in "xyz"}} for b in bodies],
    }
    channels = tuple(Channel(f"{b}_{a}", "m", "position", 1e-3) for b in bodies for a in "xyz")
    return Study("meeting", "rigid_body", channels, tuple(runs), model=model)


def basin(folder: Path) -> Study:
    """A basin that a pump fills and that may spill, recorded often."""
    time = 0.02 * np.arange(400)
    runs = []
    for k in range(2):
        pump = np.where(time < 5.0 - k, 2.0, 0.5)
        level = np.cumsum(0.02 * (pump - 0.4)) / 3.0
        runs.append(Run(f"r{k}", time, level[:, None], {"pump": pump}, f"r{k}", k))
    model = {
        "system": "ode",
        "states": {"h": 0.0},
        "inputs": [{"name": "pump", "held": True}],
        "parameters": {"area": {"value": 3.0, "percent": 10, "unit": "m^2"}},
        "rates": {"h": "(pump - 0.4)/area"},
        "readings": {"level": "h"},
        "stores": [
            {"name": "basin", "level": "h", "unit": "m", "area": "area", "area_unit": "m^2"}
        ],
    }
    channel = Channel("level", "m", "position", 1e-3)
    return Study("basin", "ode", (channel,), tuple(runs), model=model)


STUDIES: dict[str, Make] = {
    "arm": of("systems.rod.test_rod_description.study"),
    "basin": basin,
    "chip": chip,
    "fish": fish,
    "held": of("systems.test_ode_description.held_cart"),
    "hexarotor": hexarotor,
    "joints": of("systems.test_flow_description.described", seed=1),
    "meeting": meeting,
    "nanobench": published(
        "nanobench",
        runs=[{"name": n, "file": f"{n}.csv", "use": "fit", **CUT} for n in ("circle", "dash")],
    ),
    "near ground": of("systems.test_window_lengths.near_ground"),
    "seals": published("pneumatic_actuator"),
    "starfish": starfish,
    "swaying": swaying,
    "tared": of("systems.test_bench_description.tared"),
    "wind": published("wind_flights", runs=[{"file": "flight_{number}.csv"}]),
    "winding": of("systems.test_ode_description.winding"),
    "bar": of("systems.soft_body.test_instruments.bar"),
    "bounced": of("systems.test_rigid_body_description.bouncing", up="y", drag=0.1),
    "cart": of("systems.test_ode_coupled.cart", drag=0.3),
    "estimated": estimated,
    "events": pushed_cart,
    "flight": of("systems.test_copter_instruments.told"),
    "junction": of("diagnose.discover.pump_rig.recorded", uses=("fit", "test"), count=20),
    "lever": of("systems.turning_lever.lever_study"),
    "masses": of("systems.test_ode_repeat.row_of_masses"),
    "pendulum": of("systems.outside.scenes.recorded"),
    "pumps": network("pumps"),
    "regulator": network("regulator"),
    "rolling": of(
        "systems.test_rigid_body_description.rolling_study", folder=Path, resistance=0.02
    ),
    "sound": of("systems.sound_pendulum.pendulum_study", duration=2.0),
    "tossed": of("systems.test_rigid_body_description.box_study"),
    "turntable": of("diagnose.discover.turntable.turntable_study", uses=("fit", "test"), count=60),
}
