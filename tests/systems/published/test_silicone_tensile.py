"""What docs/measured/silicone_tensile.md says of the pull tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from diffsim.data import import_study
from diffsim.data.importers.common import physical
from diffsim.data.importers.silicone_tensile import LAW_SHARE, STRESS_SD_PA
from diffsim.data.study import Run
from diffsim.diagnose import diagnose
from diffsim.diagnose.gain import gain, held_out_residual
from diffsim.identify import fit
from diffsim.soft.materials import lame_parameters
from diffsim.systems.registry import setup_of
from diffsim.systems.tensile.model import PullScene
from tests.measured import data_folder

pytestmark = pytest.mark.reference
LAWS = ("yeoh_square", "power_hardening", "corotated_share")


@pytest.fixture(scope="module")
def study():
    data_folder("silicone_tensile")
    return import_study("silicone_tensile")


@pytest.fixture(scope="module")
def report(study):
    s = setup_of(study)
    return diagnose(study, s.model, s.effects, seed=0, settings=s.settings)


def fitted(study, *names):
    s = setup_of(study)
    chosen = [e for e in s.effects if e.name in names]
    return fit(s.model, study.fit_runs, study.channels, effects=chosen)


def row(report, name):
    return next(r for r in report.table if r.effect == name)


def test_verdict_and_named_laws(report):
    assert report.verdict == "ambiguous"
    assert set(report.named) == set(LAWS)
    assert report.rivals == (("unknown drift of scaled_stress",),)
    assert report.gain is not None and report.gain.low > 0.99
    for name, least in (("power_hardening", 100.0), ("corotated_share", 50.0), ("yeoh_square", 4)):
        assert row(report, name).nats > least
        assert row(report, name).gain.status == "confirmed"
    for name in ("slack", "stress_zero", "viscous_stress"):
        assert row(report, name).status == "withdrawn"


def test_rejected_and_invisible(report):
    for name in ("gent", "mooney_rivlin", "strain_scale", "relaxation", "damage"):
        assert row(report, name).nats < -3.0
    assert "load_cell_scale" in report.cannot_see


def test_gain_with_whole_parts_as_blocks(study):
    plain, named = fitted(study), fitted(study, *LAWS)
    assert gain(study.test_runs, plain, named, seed=0, block_s=1e3).low > 0.98
    gent = fitted(study, "gent")  # better where it was fitted, far off beyond
    assert gent.chi2 < 0.5 * plain.chi2
    assert gain(study.test_runs, plain, gent, seed=0, block_s=1e3).high < 0.0


def test_error_between_and_beyond_the_fitted_strains(study):
    named = fitted(study, *LAWS)
    parts = {"between": [], "beyond": []}
    for run in study.test_runs:
        strain = run.command["engineering_strain"]
        is_beyond = strain > 2.0 / 3.0 * strain[-1]
        left = held_out_residual(named, run)
        parts["between"] += list(left[~is_beyond])
        parts["beyond"] += list(left[is_beyond])
    error = {k: np.sqrt(np.mean(np.square(v))) for k, v in parts.items()}  # per cent
    assert error["between"] < 1.5
    assert 2.0 < error["beyond"] < 6.0


def test_small_strain_modulus_is_below_that_of_the_beam(study):
    for extra in ((), ("slack",)):
        found = fitted(study, *LAWS, *extra)
        modulus = found.values["youngs_modulus_dragon_skin_10"]
        assert 95e3 < modulus < 135e3
        assert modulus + 10 * found.sd["youngs_modulus_dragon_skin_10"] < 263_824


def test_plain_stress_is_the_librarys_neo_hookean():
    """Uniaxial stress of the library's density with free sides, nu -> 1/2, by its energy."""
    mu, lam = (float(x) for x in lame_parameters(torch.tensor(1e5), torch.tensor(0.49999)))

    def energy(el, side):
        j = el * side**2
        first = el**2 + 2 * side**2
        return 0.5 * mu * (first - 3) - mu * np.log(j) + 0.5 * lam * np.log(j) ** 2

    def relaxed(el):
        slope = lambda b: (energy(el, b + 1e-6) - energy(el, b - 1e-6)) / 2e-6  # noqa: E731
        return energy(el, brentq(slope, 0.9 * el**-0.5, 1.1 * el**-0.5))

    strain = np.array([0.1, 0.5, 2.0])
    stress = [(relaxed(1 + e + 1e-4) - relaxed(1 + e - 1e-4)) / 2e-4 for e in strain]
    run = Run("x", strain, strain[:, None], {}, "x")
    scene = PullScene(run, torch.tensor(1e5).double(), torch.from_numpy(strain))
    found = physical(scene.simulate().numpy()[:, 0], STRESS_SD_PA, LAW_SHARE)
    np.testing.assert_allclose(found, stress, rtol=2e-3)


def test_effects_are_nothing_at_zero(study):
    s, run = setup_of(study), study.fit_runs[0]
    q = s.model.at_prior()
    plain = s.model.predict(run, q)
    for effect in s.effects:
        size = torch.zeros(len(effect.components), dtype=torch.float64)
        torch.testing.assert_close(s.model.predict(replace(run), q, {effect: size}), plain)
