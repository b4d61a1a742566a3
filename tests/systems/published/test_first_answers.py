"""First answer of a published set by the command alone, unlisted laws among the causes."""

import json

import pytest

from diffsim.cli import main
from tests.measured import data_folder


@pytest.mark.reference
@pytest.mark.story
def test_a_first_answer_names_the_main_causes_within_its_budget(tmp_path):
    data_folder("pneumatic_arm")
    name = "pneumatic_arm_p25"
    assert main(["diagnose", "explain", name, "--budget", "quick", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["verdict"] == "named"
    assert set(report["named"]) >= {"ballooning", "slow_share"}
    given = report["settings"]["search"]["refit_steps"]
    assert report["settings"]["work"]["steps"] < 2.0 * given
