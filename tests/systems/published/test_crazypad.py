"""Crazyflies with cut propellers and weights: each group judged by the others, from its YAML."""

from pathlib import Path

import pytest

from diffsim.data import load_study
from diffsim.data.study_check import check_study
from diffsim.diagnose.faults import judge_faults
from diffsim.diagnose.faults.groups import groups_of
from diffsim.systems import published
from diffsim.systems.registry import setup_of
from tests.measured import data_folder

pytestmark = pytest.mark.reference
FILE = Path(published.__file__).parent / "crazypad.yaml"


@pytest.fixture(scope="module")
def study():
    data_folder("crazypad")
    return load_study(FILE)


def judged(study, *starts):
    """Verdicts on groups whose label begins so, by label."""
    labels = [g.label for g in groups_of(study, study.faults) if g.label.startswith(starts)]
    report = judge_faults(study, setup_of(study), groups=labels)
    return {v.group: v for v in report.verdicts}


@pytest.mark.cpu(10)  # 75 logs are read: 1.4 s alone, 6 s beside all that earlier tests have left
def test_the_file_is_short_and_finds_its_groups(study):
    assert len(FILE.read_text().splitlines()) <= 60
    assert not [p for p in check_study(study) if p.severity == "error"]
    groups = groups_of(study, study.faults)
    assert (len(study.runs), len(groups)) == (75, 28)
    assert sum(g.known == () for g in groups) == 6
    assert sum(g.known is None for g in groups) == 3


@pytest.mark.slow
def test_sound_days_and_what_carries_no_thrust_stay_silent(study):
    verdicts = judged(study, "normal", "tape", "weight_on_string")
    assert len(verdicts) == 9
    assert not [v.words for v in verdicts.values() if v.causes]


@pytest.mark.slow
def test_large_cuts_are_named_with_sizes_that_make_sense(study):
    verdicts = judged(
        study,
        "propeller_cut_m3_3",
        "propeller_cut_m1_m2_m1_2p5",
        "propeller_cut_m1_m2_m1_3",
    )
    assert len(verdicts) == 5
    assert all(v.is_right for v in verdicts.values())
    one = verdicts["propeller_cut_m3_3p5_3p5_mm_e8"].sizes[0].interval
    # of 47 mm 7 mm are gone; thrust at one voltage falls with a power of the diameter, 1 to 4
    assert one.high > 1 - (40 / 47) ** 1
    assert one.low < 1 - (40 / 47) ** 4


@pytest.mark.slow
def test_a_weight_on_one_side_is_not_told_from_two_weak_rotors(study):
    (verdict,) = judged(study, "weight_taped").values()
    assert verdict.causes == ("weight_at_3_4",)
    assert ("loss_3", "loss_4") in verdict.rivals
    assert verdict.sizes[0].interval.low < 0.05 < verdict.sizes[0].interval.high
