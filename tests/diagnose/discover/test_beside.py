"""A law that nobody listed and a cause of the library, which help only together."""

import pytest

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.diagnose.diagnosis import diagnosed
from labs.search_compare.cars import CARS


@pytest.mark.story  # a whole first answer, laws looked for, and causes beside them: 15 CPU s
def test_a_car_that_understeers_and_steers_late_is_told_by_both():
    """Alone the law leaves 12 noise sd, and no cause of the library less than 40."""
    study = CARS["car"].record(0, False)
    report = diagnosed(inputs_of(study, seed=0, budget="quick"))
    assert report.verdict == "described" and "delay_of_steer" in report.best_names
    law, *others = report.described.laws
    assert not others and law.entry == {"kind": "number", "target": "wheelbase"}
    assert law.variables == ("speed",) and law.form == "power"
    assert max(row.after / row.noise for row in report.errors) < 1.2


def test_nothing_is_named_of_a_car_that_does_neither():
    report = diagnosed(inputs_of(CARS["car"].record(3, True), seed=0, budget="quick"))
    assert report.verdict == "none"
