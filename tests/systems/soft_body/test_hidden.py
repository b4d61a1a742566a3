"""A cause hidden in a small described body is found among its rivals."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Study
from diffsim.identify.fitting import fit
from diffsim.systems.registry import setup_of

from .described import BAR, predicted, run_of, study_of

FALL_S = np.arange(-1, 12) * 0.02


def recorded(study: Study, sizes: dict[str, float], sd: float = 1e-4) -> Study:
    """The study with what the model shows under hidden causes, and noise."""
    rng = np.random.default_rng(3)
    shown = predicted(study, sizes, youngs_modulus=0.4)
    runs = tuple(
        replace(run, measured=y.numpy() + sd * rng.standard_normal(y.shape))
        for run, y in zip(study.runs, shown, strict=True)
    )
    return replace(study, runs=runs)


def test_the_inertia_of_a_hung_load():
    runs = (run_of("light", FALL_S, load_kg=0.0), run_of("heavy", FALL_S, load_kg=0.006))
    seen = (Channel("tip_z_m", "m", "position", 5e-4),)
    study = recorded(study_of(BAR, runs, seen), {"load_inertia": 1.0}, sd=5e-4)
    setup = setup_of(study)
    rivals = ("load_inertia", "tip_mass", "loss_factor", "weight")
    fits = {
        e.name: fit(setup.model, study.runs, study.channels, effects=[e], max_evaluations=8)
        for e in setup.effects
        if e.name in rivals
    }
    found = fits.pop("load_inertia")
    assert found.values["load_inertia"] == pytest.approx(1.0, abs=4.0 * found.sd["load_inertia"])
    assert found.sd["load_inertia"] < 0.1
    assert found.chi2 < 1.5 * found.num_samples
    assert min(f.chi2 for f in fits.values()) > found.chi2 + 80.0
