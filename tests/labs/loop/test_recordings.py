"""The study of the published recordings against facts from their own notes."""

import numpy as np
import pytest

from diffsim.data import check_study, load_study, save_study
from labs.loop.recordings import import_starfish
from tests.measured import data_folder

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def study():
    data_folder("starfish")  # skips where it is absent
    return import_starfish()


def test_counts_and_gates(study):
    errors = [p for p in check_study(study) if p.severity == "error"]
    assert (len(study.runs), len(study.channels), len(study.test_runs)) == (4, 8, 1)
    assert not errors, [str(p) for p in errors]
    assert study.metadata["held_out_because"]
    assert "licence" in study.metadata["source"]


def test_round_trip(study, tmp_path):
    save_study(study, tmp_path / "starfish")
    again = load_study(tmp_path / "starfish")
    assert again.channels == study.channels
    for a, b in zip(study.runs, again.runs, strict=True):
        np.testing.assert_array_equal(a.time_s, b.time_s)
        np.testing.assert_array_equal(a.measured, b.measured)


def run(study, name):
    return next(r for r in study.runs if r.name == name)


def column(study, name):
    return [c.name for c in study.channels].index(name)


def test_starfish_command_starts_at_zero_and_moves_the_robot(study):
    for r in study.runs:
        u = r.command["tendon_contraction_m"]
        before = u[r.time_s < -0.02]
        assert np.ptp(before) < 1e-5
        assert np.nanmax(u) < 0.065
    swim = run(study, "baseline")
    x = swim.measured[:, column(study, "m2_x_m")]
    assert np.nanmean(x[-50:]) < np.nanmean(x[:20]) - 0.02  # towards -x
