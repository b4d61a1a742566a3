"""What docs/measured/cube_toss.md says of the tossed cube, with nothing but its description."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.cli.diagnose_inputs import read_study
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.gain import gain
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from diffsim.systems.rigid_body.windows import CORNERS
from tests.measured import data_folder

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def setup():
    data_folder("cube_toss")
    return setup_of(read_study("cube_toss"))


def fitted(setup, *names):
    chosen = [e for e in setup.effects if e.name in names]
    return fit(setup.model, setup.study.fit_runs, setup.study.channels, effects=chosen)


@pytest.fixture(scope="module")
def plain(setup):
    return fitted(setup)


@pytest.mark.slow
def test_lengths_are_named_and_gravity_is_not(setup):
    report = diagnose(setup.study, setup.model, setup.effects, seed=0, settings=setup.settings)
    assert report.verdict == "named"
    causes = {c.name: c for c in report.causes}
    status = {name: c.status for name, c in causes.items()}
    assert status["length_scale"] == "certain"
    for name, needed in (("weaker_gravity", 0.2), ("clock_scale", 0.011)):
        assert status[name] in ("refuted", "not visible below")
        assert causes[name].probability < 1e-3
        assert causes[name].smallest_visible["size"] < 0.1 * needed  # to say the fall alone
    assert status["contact_time"] == "not judged"  # no frames after the impact
    assert report.gain is not None and report.gain.low > 0.8
    assert report.findings == ()  # the edge keeps to its data sheet


def test_lengths_are_two_per_cent_short(setup, plain):
    scaled = fitted(setup, "length_scale")
    assert scaled.values["length_scale"] == pytest.approx(-0.022, abs=0.001)
    found = gain(setup.study.test_runs, plain, scaled, seed=0)
    assert found.low > 0.5


def test_rivals_need_two_causes_for_the_same_fit(setup):
    one = fitted(setup, "length_scale")
    for pair in (("clock_scale", "ground_height"), ("weaker_gravity", "ground_height")):
        two = fitted(setup, *pair)
        assert two.chi2 == pytest.approx(one.chi2, abs=20.0)
        alone = fitted(setup, pair[0])
        assert alone.chi2 > one.chi2 + 100.0


def test_spin_drag_is_rejected(setup):
    found = fitted(setup, "length_scale", "spin_drag")
    assert found.values["spin_drag"] < 0.03


def test_study_through_the_impact():
    """Where a toss goes on, its corner has come down to the board and goes up again."""
    data_folder("cube_toss")
    study = read_study("cube_toss")
    window = {"until": "rebound", "near": "3 mm", "rest_frames": 10}
    cut = setup_of(replace(study, model={**study.model, "window": window})).study
    hit = [r for r in cut.runs if r.setup["_hits"]]
    assert 25 <= len(hit) <= 40
    for run in hit:
        q = run.measured[:, 3:7]
        w, v = q[:, :1], q[:, 1:]
        corner = 0.0524 * CORNERS[int(run.setup["_corner"])]
        turned = corner + 2.0 * np.cross(v, np.cross(v, corner) + w * corner)
        height = run.measured[:, 2] + turned[:, 2]
        lowest = int(np.argmin(height))
        assert height[lowest] < 0.003
        assert lowest < len(height) - 2
        assert np.all(np.diff(height[lowest:]) > 0.0)
