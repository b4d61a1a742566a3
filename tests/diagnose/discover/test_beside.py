"""A law that nobody listed and a cause of the library, which help only together."""

from dataclasses import replace

import pytest

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.diagnose.diagnosis import diagnosed
from labs.search_compare.cars import CARS
from tests.diagnose.discover.answers import few_laws

FEW = ("delay_of_steer", "lag_of_steer", "command_gain_of_steer", "dead_band_of_steer",
       "command_gain_of_speed", "delay_of_speed")  # fmt: skip


@pytest.mark.story  # a whole first answer, laws looked for, and causes beside them
def test_a_car_that_understeers_and_steers_late_is_told_by_both():
    """Alone the law leaves 12 noise sd, and no cause of the library less than 40."""
    study = CARS["car"].record(0, False)
    study = replace(study, model={**study.model, "effects": {"only": FEW}})
    with few_laws():
        report = diagnosed(inputs_of(study, seed=0, budget="quick"))
    assert report.verdict == "described" and "delay_of_steer" in report.best_names
    law, *others = report.described.laws
    assert not others and law.entry == {"kind": "number", "target": "wheelbase"}
    assert law.variables == ("speed",) and law.form == "power"
    assert max(row.after / row.noise for row in report.errors) < 1.2


def test_nothing_is_named_of_a_car_that_does_neither():
    report = diagnosed(inputs_of(CARS["car"].record(3, True), seed=0, budget="quick"))
    assert report.verdict == "none"
