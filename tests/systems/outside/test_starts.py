"""Starts of runs whose best guess is each run's first reading."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from diffsim.systems.outside.starts import StartQuantity, with_first_readings
from diffsim.systems.registry import description_of
from tests.studies import study_of


def test_a_start_is_the_first_reading_that_was_made_within_its_bounds():
    study = study_of("outside")
    channel = study.channels[0].name
    runs = []
    for k, run in enumerate(study.runs):
        measured = run.measured.copy()
        measured[:k, 0], measured[k, 0] = np.nan, 0.1 * (k + 1)
        runs.append(replace(run, measured=measured))
    silent = np.full_like(runs[-1].measured, np.nan)
    runs[-1] = replace(runs[-1], measured=silent)
    study = replace(study, runs=tuple(runs))
    start = StartQuantity(first=channel, sd=0.5, per="run", upper=0.15)
    base = tuple(start.parameter(f"angle@{run.name}") for run in runs)
    found = with_first_readings((*base, replace(base[0], name="mass")), {"angle": start}, study)
    values = [p.value for p in found]
    expected = [min(0.1 * (k + 1), 0.15) for k in range(len(runs) - 1)]
    # one that was never read begins as the others in the mean, or at the bound
    assert values == pytest.approx([*expected, 0.15, 0.0])
    assert {p.sd for p in found} == {0.5}


@pytest.mark.parametrize("more", [{}, {"sd": 0.1}, {"sd": 0.1, "per": "load"}])
def test_a_first_reading_is_of_each_run_and_as_far_off_as_is_stated(more):
    with pytest.raises(ValidationError, match="first needs per: run and sd"):
        StartQuantity(first="angle", **more)


@pytest.mark.parametrize("given", [{}, {"value": 0.0, "first": "angle"}])
def test_a_start_has_a_value_or_a_first_reading(given):
    with pytest.raises(ValidationError, match=r"value.*first"):
        StartQuantity(sd=0.1, per="run", **given)


def test_a_channel_that_is_not_there_is_said():
    study = study_of("outside")
    first = {"first": "angle_red", "sd": 0.1, "per": "run"}
    study = replace(study, model={**study.model, "start": {"angle": first}})
    problems = description_of(study).problems(study)
    (problem,) = [p for p in problems if p.severity == "error"]
    assert problem.where == "model.start.angle.first"
    assert problem.message.startswith("no channel 'angle_red'; did you mean 'angle_rad'")
