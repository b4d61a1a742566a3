"""First answers of published sets by the command alone, unlisted laws among the causes."""

import json

import pytest

from diffsim.cli import main
from tests.measured import data_folder

pytestmark = [pytest.mark.reference, pytest.mark.story]

# what a first answer must name
NAMED = {
    "cube_toss": {"length_scale", "center_offset"},
    "pneumatic_arm_p25": {"ballooning", "slow_share"},
}


@pytest.mark.parametrize(
    "name",
    # tosses are told apart in tests/systems/published/test_cube_toss.py
    ["pneumatic_arm_p25", "cube_toss"],
)
def test_a_first_answer_names_the_main_causes_within_its_budget(name, tmp_path):
    data_folder(name.removesuffix("_p25"))
    assert main(["diagnose", "explain", name, "--budget", "quick", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["verdict"] == "named"
    assert set(report["named"]) >= NAMED[name]
    given = report["settings"]["search"]["refit_steps"]
    assert report["settings"]["work"]["steps"] < 2.0 * given
