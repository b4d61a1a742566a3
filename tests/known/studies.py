"""Studies beside those of ``tests/studies``, from the rooms' tests: whose causes are known, too."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from diffsim.data import load_study
from diffsim.data.study import Study

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


STUDIES: dict[str, Make] = {
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
