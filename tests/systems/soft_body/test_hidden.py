"""Causes hidden in small described bodies are found, and nothing is where there is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.identify.fitting import fit
from diffsim.systems.registry import setup_of

from .described import BAR, TENDON, predicted, run_of, study_of

FALL_S = np.arange(-1, 12) * 0.02
PULL_S = np.arange(40) * 0.03


def recorded(study: Study, sizes: dict[str, float], sd: float = 1e-4) -> Study:
    """The study with what the model shows under hidden causes, and noise."""
    rng = np.random.default_rng(3)
    shown = predicted(study, sizes, youngs_modulus=0.4)
    runs = tuple(
        replace(run, measured=y.numpy() + sd * rng.standard_normal(y.shape))
        for run, y in zip(study.runs, shown, strict=True)
    )
    return replace(study, runs=runs)


def named(study: Study) -> Any:
    setup = setup_of(study)
    return diagnose(study, setup.model, setup.effects, seed=0, unknowns=(), settings=setup.settings)


def strokes(reach_m: float, period: int) -> np.ndarray:
    return reach_m * 0.5 * (1.0 + np.sign(np.sin(2 * np.pi * (np.arange(40) - 4) / period)))


def pulled(name: str, command: np.ndarray, use: str = "fit") -> Run:
    return run_of(name, PULL_S, use=use, command={"pull_m": command})


def test_the_inertia_of_a_hung_load():
    runs = (run_of("light", FALL_S, load_kg=0.0), run_of("heavy", FALL_S, load_kg=0.006))
    seen = (Channel("tip_z_m", "m", "position", 5e-4),)
    study = recorded(study_of(BAR, runs, seen), {"load_inertia": 1.0}, sd=5e-4)
    setup = setup_of(study)
    rivals = ("load_inertia", "tip_mass", "loss_factor", "weight")
    fits = {
        e.name: fit(setup.model, study.runs, study.channels, effects=[e], max_evaluations=25)
        for e in setup.effects
        if e.name in rivals
    }
    found = fits.pop("load_inertia")
    assert found.values["load_inertia"] == pytest.approx(1.0, abs=4.0 * found.sd["load_inertia"])
    assert found.sd["load_inertia"] < 0.1
    assert found.chi2 < 1.5 * found.num_samples
    assert min(f.chi2 for f in fits.values()) > found.chi2 + 80.0


def test_a_speed_limit_and_slack_of_a_tendon():
    runs = (
        pulled("far", strokes(8e-3, 24)),
        pulled("near", strokes(5e-3, 16)),
        pulled("other", strokes(7e-3, 20), "select"),
        pulled("farther", strokes(9e-3, 30), "test"),
    )
    only = {"only": ["rate_limit", "tendon_slack", "lag", "command_gain"]}
    study = study_of(TENDON, runs, effects=only, effort={"max_effects": 2})
    report = named(recorded(study, {"rate_limit": 30.0, "tendon_slack": 2e-3}, sd=5e-5))
    assert set(report.named) == {"rate_limit", "tendon_slack"}
