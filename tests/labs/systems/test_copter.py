"""The copter library on the real simulator against the independent laboratory."""

import numpy as np
import pytest
import torch

from diffsim.diagnose import diagnose
from diffsim.identify import fit
from diffsim.systems.multicopter import CopterModel
from labs.systems import setup_of
from labs.virtual import CopterLab
from tests.labs.short_copter import ShortCopterLab

pytestmark = pytest.mark.reference
# library's name and its share of the laboratory's components
SAME_SIZE = {
    **{
        name: name
        for name in (
            "body_drag",
            "parasitic_drag",
            "wind",
            "body_tilt",
            "voltage_exponent",
            "center_of_mass",
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


def fit_at_true_size(name, lab):
    """Base parameters fitted to noise-free data, the library's term fixed at the true size."""
    case = lab.case(3, {name: None})
    setup = setup_of(case.study)
    effect = next(e for e in setup.effects if e.name == SAME_SIZE[name])
    truth = case.truth["effects"][name][: len(effect.components)]
    model = with_effect(setup.model, effect, torch.tensor(truth, dtype=torch.float64))
    return fit(model, case.study.fit_runs, case.study.channels)


class ShortQuietLab(ShortCopterLab, QuietLab):
    """Both."""


@pytest.mark.parametrize("name", ["lag", "gyroscopic", "ground_effect", "center_of_mass"])
def test_the_library_term_at_the_true_size_is_the_laboratorys(name):
    """What is left of noise-free data, in noise sd per sample."""
    found = fit_at_true_size(name, ShortQuietLab())
    assert np.sqrt(found.chi2 / found.num_samples) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", SAME_SIZE)
def test_every_library_term_at_the_true_size_is_the_laboratorys(name):
    found = fit_at_true_size(name, QuietLab())
    assert np.sqrt(found.chi2 / found.num_samples) < 0.1


def test_a_hidden_cause_is_named():
    """Among a few candidates, from two short flights."""
    name = "body_drag"
    case = ShortCopterLab().case(5, {name: None})
    setup = setup_of(case.study)
    few = ("body_drag", "lag", "wind", "inflow", "thrust_curvature")
    candidates = [e for e in setup.effects if e.name in few]
    report = diagnose(case.study, setup.model, candidates, seed=0)
    assert (report.verdict, report.named) == ("named", (name,))
    row = next(r for r in report.table if r.effect == name)
    assert row.size["size"] == pytest.approx(
        case.truth["effects"][name][0], abs=2.6 * row.sd["size"]
    )
    assert report.gain.low > 0.5


def test_the_bank_is_what_the_nominal_vehicle_flies():
    setup = setup_of(ShortCopterLab().case(5, {}).study)
    names = [run.name for run in setup.bank]
    assert len(names) == len(set(names)) >= 6
    sd = np.repeat([1e-3, 2e-3, 0.01, 0.08], 3)
    for run in setup.bank[:4]:
        with torch.no_grad():
            here = setup.model.predict(run, setup.model.at_prior()).numpy()
        # the nominal vehicle made them; thrusts before the record are guessed
        assert np.sqrt((((here - run.measured) / sd) ** 2).mean()) < 0.1, run.name
