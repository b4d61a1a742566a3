"""Studies of the published recordings against facts from their own notes."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.data import IMPORTERS, check_study, import_study, load_study, save_study
from tests.measured import data_folder

pytestmark = pytest.mark.reference

#: name: runs, channels, held out, errors that the data cannot help having
EXPECTED = {
    "silicone_beam": (4, 9, 1, 0),
    "starfish": (4, 8, 1, 0),
}


@pytest.fixture(scope="module")
def studies():
    for folder, _ in IMPORTERS.values():
        data_folder(folder)  # skips where it is absent
    return {name: import_study(name) for name in IMPORTERS}


@pytest.mark.parametrize("name", list(IMPORTERS))
def test_counts_and_gates(studies, name):
    study = studies[name]
    errors = [p for p in check_study(study) if p.severity == "error"]
    counts = len(study.runs), len(study.channels), len(study.test_runs), len(errors)
    assert counts == EXPECTED[name], [str(p) for p in errors]
    assert study.metadata["held_out_because"]
    assert "licence" in study.metadata["source"]


@pytest.mark.parametrize("name", list(IMPORTERS))
def test_round_trip(studies, name, tmp_path):
    study = studies[name]
    save_study(study, tmp_path / name)
    again = load_study(tmp_path / name)
    assert again.channels == study.channels
    for a, b in zip(study.runs, again.runs, strict=True):
        np.testing.assert_array_equal(a.time_s, b.time_s)
        np.testing.assert_array_equal(a.measured, b.measured)


def run(study, name):
    return next(r for r in study.runs if r.name == name)


def column(study, name):
    return [c.name for c in study.channels].index(name)


def test_beam_sags_as_noted(studies):
    study = studies["silicone_beam"]
    z = [column(study, f"tip{i}_z_m") for i in (1, 2, 3)]
    gravity = run(study, "gravity_a").measured[-100:, z].mean()
    assert gravity == pytest.approx(-6.49e-3, abs=0.06e-3)
    assert run(study, "load52_b").use == "test"


def test_starfish_command_starts_at_zero_and_moves_the_robot(studies):
    study = studies["starfish"]
    for r in study.runs:
        u = r.command["tendon_contraction_m"]
        before = u[r.time_s < -0.02]
        assert np.ptp(before) < 1e-5
        assert np.nanmax(u) < 0.065
    swim = run(study, "baseline")
    x = swim.measured[:, column(study, "m2_x_m")]
    assert np.nanmean(x[-50:]) < np.nanmean(x[:20]) - 0.02  # towards -x


def test_unknown_name_offers_the_closest():
    with pytest.raises(ValueError, match="did you mean 'silicone_beam'"):
        import_study("silicon_beam")
