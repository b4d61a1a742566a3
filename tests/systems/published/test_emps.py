"""What docs/measured/emps.md says of the positioning system, with nothing but its description."""

import pytest

from diffsim.cli.diagnose_inputs import read_study
from tests.diagnose.discover.answers import answer
from tests.measured import data_folder

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def study():
    data_folder("emps")
    return read_study("emps")


@pytest.mark.slow
def test_the_force_that_nobody_told_about_is_named(study):
    report = answer(study)
    assert report.verdict == "named"
    named = {row.name: row for row in report.causes if row.name in report.named}
    assert all(row.status == "certain" or row.doubts for row in named.values())
    train = next(row for name, row in named.items() if name.startswith("train_event_at_"))
    assert train.name.endswith(("carriage", "drive"))  # behind the controller
    assert train.words.startswith("pulses of 17")
    times = {row.name: row.value for row in report.base}
    assert times["event_onset"] == pytest.approx(0.344, abs=0.001)
    assert times["event_width"] == pytest.approx(0.5, abs=0.001)
    assert times["event_period"] == pytest.approx(1.0, abs=1e-4)
    assert {"dry_friction", "viscous_friction", "viscous_asymmetry"} <= set(named)
    after = {row.run: row.after for row in report.errors if row.kind == "position"}
    assert max(after.values()) < 2.0  # um; the controller's own step is 0.05
