"""The copter library on the real simulator against the independent laboratory."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffsim.data.labs import CopterLab
from diffsim.diagnose.beds.copter import CopterModel
from diffsim.diagnose.setups import setup_of
from diffsim.identify import fit

pytestmark = pytest.mark.reference
# library's name and its share of the laboratory's components
SAME_SIZE = {
    **{
        name: name
        for name in (
            "linear_drag",
            "parasitic_drag",
            "wind",
            "body_tilt",
            "voltage_exponent",
            "centre_of_mass",
            "ground_effect",
            "inflow",
            "thrust_curvature",
            "gyroscopic",
            "lag",
            "delay",
            "accelerometer_scale",
            "gyro_offset",
        )
    },
    "weak_rotor": "weak_rotor_1",
}


class QuietLab(CopterLab):
    """Sensors without noise."""

    def _noise(self, rng, n, decoys):
        return np.zeros((n, len(self.channels)))


def with_effect(model, effect, size):
    """The model with the effect built in at a fixed size."""

    def build(values, run, numerics):
        return effect.apply(model.build(values, run, numerics), size, run)

    return CopterModel(build, model.base)


def misfit_at_true_size(name):
    """Noise sd per sample that the library's term leaves of noise-free data, base refitted."""
    lab = QuietLab()
    case = lab.case(3, {name: None})
    setup = setup_of(case.study)
    effect = next(e for e in setup.effects if e.name == SAME_SIZE[name])
    truth = case.truth["effects"][name][: len(effect.components)]
    model = with_effect(setup.model, effect, torch.tensor(truth, dtype=torch.float64))
    found = fit(model, case.study.fit_runs, case.study.channels)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", SAME_SIZE)
def test_the_library_term_at_the_true_size_is_the_laboratorys(name):
    found = misfit_at_true_size(name)
    assert np.sqrt(found.chi2 / found.num_samples) < 0.1
