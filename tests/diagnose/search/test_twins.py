"""Causes that do the same, where linear evidence of the other one is far off."""

import numpy as np
import pytest

from diffsim.data.study import Study
from labs.search_compare.rigs import make_study, with_noise
from tests.diagnose.discover.answers import answer

PACE, NOISE = 0.75, 0.02


def wheel() -> Study:
    """A marker on a wheel that turns at three quarters of what is stated, or so a camera says."""
    rng, t = np.random.default_rng(4), 0.02 * np.arange(300.0)
    runs = []
    for frequency in (1.0, 1.6, 2.3):
        turned = 2.0 * np.pi * frequency * PACE * t
        shown = np.stack([np.sin(turned), np.cos(turned)], 1)
        runs.append((shown, {"rate": np.full_like(t, 2.0 * np.pi * frequency)}))
    paces = {n: {"changes": {n: f"{n}*(1 + size)"}} for n in ("drive", "camera")}
    own = [
        {"name": f"{n}_pace", "typical": 0.25, "scanned": True, "family": "pace"} | row
        for n, row in paces.items()
    ]
    return make_study(
        "wheel",
        {"across": "m", "up": "m"},
        t,
        with_noise(rng, runs, NOISE),
        parameters={"drive": (1.0, 1e-6), "camera": (1.0, 1e-6), "r": (1.0, 2)},
        inputs=[{"name": "rate", "held": True}],
        states={"turn": 0},
        rates={"turn": "drive*camera*rate"},
        readings={"across": "r*sin(turn)", "up": "r*cos(turn)"},
        effects={"only": [row["name"] for row in own], "own": own},
    )


@pytest.mark.cpu(10)
def test_of_two_exact_twins_none_is_named_alone():
    report = answer(wheel())
    sets = {frozenset(names) for names in (report.best_names, *report.rivals)}
    assert {frozenset({"drive_pace"}), frozenset({"camera_pace"})} <= sets
    assert not {"certain", "likely"} & {row.status for row in report.causes}
    first = report.headline.partition(";")[0]
    assert "drive pace" in first and "camera pace" in first
