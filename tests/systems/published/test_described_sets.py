"""Measured sets described by formulas: their causes, sizes, and runs that no fit has seen."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from diffsim.data import load_study
from diffsim.data.study_check import check_study
from diffsim.systems import published
from tests.measured import data_folder
from tests.systems.published.fits import fitted

pytestmark = pytest.mark.reference
#: study: folder of its data, runs to fit and to test
SETS = {
    "pneumatic_arm": ("pneumatic_arm", 4, 1),
    "pneumatic_arm_p25": ("pneumatic_arm", 9, 1),
    "fish_tail": ("fish_tail", 1, 0),
    "rotor_bench": ("rotor_bench", 23, 4),
    "rotor_drive": ("rotor_bench", 23, 4),
    "silicone_tensile": ("silicone_tensile", 15, 15),
    "f1tenth_car": ("f1tenth_car", 13, 4),
    "motor_pendulum": ("motor_pendulum", 32, 6),
    "so101": ("so101", 3, 1),
}


def read(name):
    data_folder(SETS[name][0])
    return load_study(Path(published.__file__).parent / f"{name}.yaml")


def left(found, run):
    """Measured less predicted, (num_samples, num_channels)."""
    with torch.no_grad():
        return run.measured - found.problem.predict(run, torch.from_numpy(found.x)).numpy()


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


@pytest.mark.parametrize("name", SETS)
def test_the_file_is_short_and_finds_its_runs(name):
    study = read(name)
    assert (len(study.fit_runs), len(study.test_runs)) == SETS[name][1:]
    assert not [p for p in check_study(study) if p.severity == "error"]
    lines = (Path(published.__file__).parent / f"{name}.yaml").read_text().splitlines()
    assert len(lines) <= 60


def fewer(study, every):
    """The study with every n-th of the runs that are fitted."""
    fitted = study.fit_runs[::every]
    return replace(study, runs=(*fitted, *study.test_runs))


@pytest.mark.parametrize(
    ("names", "every"),
    [
        pytest.param(
            ("pneumatic_arm_p25",),
            2,
            marks=pytest.mark.short_of(
                "test_both_campaigns_of_the_arm_ask_for_the_same_ballooning[both]"
            ),
        ),
        pytest.param(("pneumatic_arm", "pneumatic_arm_p25"), 1, marks=pytest.mark.slow),
    ],
    ids=["one", "both"],
)
def test_both_campaigns_of_the_arm_ask_for_the_same_ballooning(names, every):
    sizes = []
    for name in names:
        study = fewer(read(name), every)
        plain = fitted(study)
        slow = ("slow_share", "relaxing_spring_at_bend")
        found = fitted(study, "ballooning", "square_drag_at_bend", *slow)
        sizes.append(found.values["ballooning"])
        assert found.chi2 < 0.2 * plain.chi2
        assert rms(left(found, study.test_runs[0])) < 0.4 * rms(left(plain, study.test_runs[0]))
    assert sizes == pytest.approx([1.8] * len(names), abs=0.12)


def test_thrust_grows_faster_than_the_square_of_the_speed():
    study = read("rotor_bench")
    plain, found = fitted(study), fitted(study, "exponent_of_thrust")
    assert found.values["exponent_of_thrust.all"] == pytest.approx(0.1, abs=0.05)
    errors = [
        rms(np.concatenate([left(f, r).ravel() for r in study.test_runs])) for f in (plain, found)
    ]
    assert errors[1] < 0.6 * errors[0]


def test_three_laws_of_stress_carry_on_beyond_the_fitted_strains():
    study = read("silicone_tensile")
    plain = fitted(study)
    found = fitted(study, "power_hardening", "corotated_share", "yeoh_square")
    errors = [
        rms(np.concatenate([left(f, r).ravel() for r in study.test_runs])) for f in (plain, found)
    ]
    assert errors[1] < 6.0 < 0.2 * errors[0]  # per cent
    assert 95e3 < found.values["youngs_modulus[material=dragon_skin_10]"] < 135e3
