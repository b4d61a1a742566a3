"""What the page of the tennis balls claims, with nothing but their description."""

import numpy as np
import pytest
import torch

from diffsim.cli.diagnose_inputs import read_study
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.gain import gain
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from diffsim.systems.rigid_body.ball_setup import CLICKS
from tests.measured import data_folder

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def setup():
    data_folder("tennis_balls")
    return setup_of(read_study("tennis_balls"))


def fitted(setup, *names):
    chosen = [e for e in setup.effects if e.name in names]
    return fit(setup.model, setup.study.fit_runs, setup.study.channels, effects=chosen)


def clicks_rms(found):
    run = next(r for r in found.problem.runs if r.name == CLICKS)
    with torch.no_grad():
        seen = found.problem.predict(run, torch.from_numpy(found.x)).numpy()
    return np.sqrt(np.nansum((run.measured - seen)[:, 4:] ** 2) / 8)


def test_friction_predicts_the_frames_left_out(setup):
    null = fitted(setup)
    found = fitted(setup, "sliding_friction", "ball_friction", "contact_time")
    gained = gain(setup.study.test_runs, null, found, seed=0)
    assert found.chi2 < 0.3 * null.chi2
    assert gained.value > 0.8 and gained.low > 0.0


def test_lens_explains_the_clicks(setup):
    clicks = [r for r in setup.study.fit_runs if r.name == CLICKS]
    lens = [e for e in setup.effects if e.name == "lens_distortion"]
    plain = fit(setup.model, clicks, setup.study.channels)
    bent = fit(setup.model, clicks, setup.study.channels, effects=lens)
    assert clicks_rms(plain) == pytest.approx(2.4, abs=0.2)  # the authors' camera: 11.3 px
    assert clicks_rms(bent) < 1.2
    assert bent.values["lens_distortion"] == pytest.approx(-0.075, abs=0.025)


@pytest.mark.slow
def test_sliding_is_likely_and_predicts_the_last_frames(setup):
    report = diagnose(setup.study, setup.model, setup.effects, seed=0, settings=setup.settings)
    cause = {c.name: c for c in report.causes}["sliding_friction"]
    assert cause.status == "likely"  # the camera's noise is a quarter of what is left
    assert any("times the noise" in why for why in cause.doubts)
    assert 0.1 < cause.size["size"].value < 0.2
    (row,) = report.errors
    assert (row.run, row.unit) == ("later", "px")
    assert row.before > 8.0 and row.after < 3.0
