"""What the page of the tennis balls claims."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.data import import_study
from diffsim.diagnose import diagnose
from diffsim.diagnose.gain import gain
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.measured import data_folder

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def given():
    data_folder("tennis_balls")
    study = import_study("tennis_balls")
    return study, setup_of(study)


def fitted(given, *names):
    study, setup = given
    chosen = [e for e in setup.effects if e.name in names]
    return fit(setup.model, study.fit_runs, study.channels, effects=chosen)


def clicks_rms(found):
    run = found.problem.runs[0]
    row = np.isfinite(run.measured).ravel().nonzero()[0] % 6 >= 4
    return np.sqrt(np.sum(found.residual[row] ** 2) / 8)  # sd of a click: 1 px


def test_friction_predicts_the_frames_left_out(given):
    study, _ = given
    null = fitted(given)
    found = fitted(given, "sliding_friction", "ball_friction")
    gained = gain(study.test_runs, null, found, seed=0)
    assert found.chi2 < 0.1 * null.chi2
    assert gained.value > 0.8 and gained.low > 0.0


def test_lens_explains_the_clicks(given):
    friction = ("sliding_friction", "ball_friction")
    plain, lens = fitted(given, *friction), fitted(given, *friction, "lens_distortion")
    assert clicks_rms(plain) == pytest.approx(2.4, abs=0.2)  # the authors' camera: 11.3 px
    assert clicks_rms(lens) < 1.2
    assert lens.values["lens_distortion"] == pytest.approx(-0.075, abs=0.025)


@pytest.mark.slow
def test_verdict(given):
    study, setup = given
    report = diagnose(study, setup.model, setup.effects, seed=0, settings=setup.settings)
    assert report.verdict == "ambiguous"
    assert set(report.named) == {"sliding_friction", "rolling_resistance", "ball_friction"}
    assert report.gain is not None and report.gain.low > 0.9
    drift = "unknown drift of ball1_u_px"
    assert any(drift in rival for rival in report.rivals)
    assert any(drift in s and "nats better" in s for s in report.sentences)
    withdrawn = {r.effect for r in report.table if r.status == "withdrawn"}
    assert withdrawn == {"lens_distortion", "table_tilt"}
