"""Studies of the published recordings against facts from their own notes."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.data import IMPORTERS, check_study, import_study, load_study, save_study
from diffsim.data.importers.common import physical
from diffsim.data.importers.rotor_bench import SCATTER
from tests.measured import data_folder

pytestmark = pytest.mark.reference

#: name: runs, channels, held out, errors that the data cannot help having
EXPECTED = {
    "silicone_beam": (4, 9, 1, 0),
    "starfish": (4, 8, 1, 0),
    "pneumatic_arm": (5, 9, 1, 0),
    "pneumatic_arm_p25": (10, 9, 1, 0),
    "fish_tail": (1, 3, 0, 0),
    "rotor_bench": (27, 2, 4, 0),
    "rotor_drive": (27, 2, 4, 0),
    "silicone_tensile": (10, 1, 5, 0),
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


def test_arm_bends_more_at_more_pressure(studies):
    for name in ("pneumatic_arm", "pneumatic_arm_p25"):
        study = studies[name]
        level, bend = [], []
        for r in study.runs:
            on = (r.command["set_pressure_Pa"] > 0) & (r.time_s > 1.0)
            rest = np.nanmedian(r.measured[r.time_s < 0.0], axis=0)
            bend.append(np.linalg.norm(np.nanmedian(r.measured[on], axis=0)[:3] - rest[:3]))
            level.append(r.setup["set_pressure_Pa"])
        assert np.all(np.diff(np.array(bend)[np.argsort(level)]) > 0.0)


def test_repeated_samples_of_the_stream_are_gaps(studies):
    shares = [np.isnan(r.measured[:, 0]).mean() for r in studies["pneumatic_arm_p25"].runs]
    assert min(shares) > 0.13 and max(shares) < 0.28  # 15-26 % (README)


def test_thrust_falls_with_the_square_of_the_speed(studies):
    study = studies["rotor_bench"]
    r = run(study, "kde2814_10in_up")
    thrust = physical(r.measured[:, column(study, "scaled_thrust_N")], *SCATTER["thrust_N"])
    speed = r.command["speed_rad_s"]
    fast = speed > 300
    slope = np.polyfit(np.log(speed[fast]), np.log(thrust[fast]), 1)[0]
    assert slope == pytest.approx(2.1, abs=0.15)
    assert r.setup["voltage_recorded"] == 0.0
    # the file itself, read apart from the importer
    table = np.genfromtxt(
        data_folder("rotor_bench") / "kde2814_10in.csv", delimiter=",", names=True, encoding=None
    )
    np.testing.assert_allclose(thrust, table["thrust_N"][: len(thrust)], rtol=1e-9)


def test_strain_rate_of_the_pull_test(studies):
    for r in studies["silicone_tensile"].runs:
        rate = np.polyfit(r.time_s, r.command["engineering_strain"], 1)[0]
        assert rate == pytest.approx(0.0075 / 0.033, rel=0.01)


def test_unknown_name_offers_the_closest():
    with pytest.raises(ValueError, match="did you mean 'silicone_beam'"):
        import_study("silicon_beam")
