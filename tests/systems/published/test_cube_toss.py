"""What docs/measured/cube_toss.md says of the tossed cube."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffsim.data import import_study
from diffsim.data.importers.cube_toss import CORNERS, import_cube_toss
from diffsim.diagnose import diagnose
from diffsim.diagnose.gain import gain
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.measured import data_folder

pytestmark = pytest.mark.reference
WHOLE = 10.0  # [s] blocks of a whole toss


@pytest.fixture(scope="module")
def study():
    data_folder("cube_toss")
    return import_study("cube_toss")


@pytest.fixture(scope="module")
def setup(study):
    return setup_of(study)


def fitted(study, setup, *names):
    chosen = [e for e in setup.effects if e.name in names]
    return fit(setup.model, study.fit_runs, study.channels, effects=chosen)


@pytest.fixture(scope="module")
def plain(study, setup):
    return fitted(study, setup)


@pytest.mark.slow
def test_verdict(study, setup):
    report = diagnose(study, setup.model, setup.effects, seed=0, settings=setup.settings)
    assert report.verdict == "unknown"
    mimics = {r.effect for r in report.table if r.status == "mimic"}
    assert "length_scale" in mimics
    assert not {"clock_scale", "weaker_gravity", "spin_drag", "half_width"} & mimics
    assert "contact_time" in report.cannot_see  # no frames after the impact


def test_lengths_are_two_per_cent_short(study, setup, plain):
    scaled = fitted(study, setup, "length_scale")
    assert scaled.values["length_scale"] == pytest.approx(-0.022, abs=0.001)
    found = gain(study.test_runs, plain, scaled, seed=0, block_s=WHOLE)
    assert found.low > 0.5
    assert found.value < 0.8  # and a third of the error is left


def test_height_at_rest_and_fall_say_the_same(study):
    """Both without the simulator: half width at rest, curvature of z in flight."""
    rest = np.median([r.measured[-1, 7] for r in study.runs])
    falls = [2.0 * np.polyfit(r.time_s, r.measured[:, 2], 2)[0] for r in study.runs]
    assert rest / 0.0524 == pytest.approx(0.979, abs=0.003)
    assert np.median(falls) / -9.81 == pytest.approx(0.979, abs=0.003)


def test_rivals_need_two_causes_for_the_same_fit(study, setup):
    one = fitted(study, setup, "length_scale")
    for pair in (("clock_scale", "ground_height"), ("weaker_gravity", "ground_height")):
        two = fitted(study, setup, *pair)
        assert two.chi2 == pytest.approx(one.chi2, abs=10.0)
        alone = fitted(study, setup, pair[0])
        assert alone.chi2 > one.chi2 + 500.0


def test_spin_drag_is_rejected(study, setup, plain):
    found = fitted(study, setup, "length_scale", "spin_drag")
    assert found.values["spin_drag"] < 0.03


def test_study_through_the_impact(study):
    """Where a toss goes on, its corner has come down to the board and goes up again."""
    tosses = import_cube_toss(data_folder("cube_toss"), after=True)
    hit = [r for r in tosses.runs if r.setup["hits"]]
    assert 25 <= len(hit) <= 40
    for run in hit:
        q = torch.from_numpy(run.measured[:, 3:7]).numpy()
        w, v = q[:, :1], q[:, 1:]
        corner = 0.0524 * CORNERS[int(run.setup["corner"])]
        turned = corner + 2.0 * np.cross(v, np.cross(v, corner) + w * corner)
        height = run.measured[:, 2] + turned[:, 2]
        lowest = int(np.argmin(height))
        assert height[lowest] < 0.003
        assert lowest < len(height) - 2
        assert np.all(np.diff(height[lowest:]) > 0.0)
