"""Laws that nobody listed, in systems that offer ports and no more."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.causes.ports import OF_FORCES
from diffsim.core.expression import parse_expression
from diffsim.diagnose.discover.stage import find_laws
from diffsim.diagnose.search.fit import silent
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem
from diffsim.identify.linearization import linearization_at
from diffsim.identify.model_file import read_extended
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.outside.forces import Term
from diffsim.systems.registry import load_extended, setup_of
from tests.diagnose.discover import pump_rig
from tests.diagnose.discover.answers import few_laws, found
from tests.diagnose.discover.pump_rig import NOISE, recorded
from tests.systems.outside import scenes

FEW = ("fit", "fit", "select", "test")
"""Runs that show what does not change from day to day."""


def with_temperature(p_a, p_b, temperature):
    return p_a + 1.5 * (temperature - 298.0)


def with_cross_talk(p_a, p_b, temperature):
    return p_a + 0.05 * (p_b - 700.0)


def stiffer_when_cold(day):
    return 1.0 - 0.004 * (day - 297.0)


def weaker_when_warm(flow):
    return flow - 0.03e9 * pump_rig.heated(flow**2, 4.0)


def entry_of(law):
    return (law.entry["kind"], law.entry["target"], law.variables, law.memory)


@pytest.fixture(scope="module")
def warm():
    with few_laws():
        return found(recorded(show=with_temperature, uses=("fit", *FEW)))


def is_confirmed(report):
    (row,) = [row for row in report.errors if row.use == "test"]
    return row.after < 1.15 * NOISE and row.before > 2.0 * NOISE


@pytest.mark.cpu(14)  # a whole diagnosis, then another one with the laws that it found
def test_a_reading_over_a_recorded_column_is_described(warm):
    assert warm.verdict == "described", warm.sentences
    law = warm.described.laws[0]
    assert entry_of(law) == ("reading", "p_a", ("temperature",), None)
    assert law.form == "line"
    size = law.numbers["amplitude"]
    assert abs(size.value - 1.5) < size.high - size.low < 0.15
    assert is_confirmed(warm)


def test_a_saved_law_is_a_row_that_judges_other_runs(warm, tmp_path):
    warm.save(tmp_path)
    other = recorded(show=with_temperature, uses=("test",), seed=7)
    other = replace(other, runs=tuple(replace(r, name="later") for r in other.runs))
    model = load_extended(tmp_path, other)
    (run,) = other.runs
    left = run.measured - model.predict(run, model.at_prior()).detach().numpy()
    assert np.sqrt(np.mean(left**2)) < 1.15 * NOISE
    assert "temperature" in read_extended(tmp_path).frame["laws"][0]["map"]


def test_nothing_is_described_where_nothing_is_hidden():
    report = found(recorded())
    assert report.verdict == "none" and report.described is None


@pytest.mark.cpu(18)  # two diagnoses, and laws of five numbers
@pytest.mark.parametrize(
    ("hidden", "entry"),
    [
        ({"show": with_cross_talk, "uses": FEW}, ("reading", "p_a", ("p_b",), None)),
        pytest.param(
            {"stiffen": stiffer_when_cold},
            ("number", "resistance_c", ("day temperature",), None),
            marks=pytest.mark.story,  # of six days
        ),
    ],
)
def test_place_and_variable_are_found(hidden, entry):
    with few_laws():
        report = found(recorded(**hidden))
    assert report.verdict == "described", report.sentences
    assert entry_of(report.described.laws[0]) == entry
    assert is_confirmed(report)


@pytest.mark.story  # of a command every term is simulated: 11 CPU s
def test_a_pump_that_warms_is_found_with_its_time():
    report = found(recorded(pump=weaker_when_warm, uses=FEW))
    assert report.verdict == "described", report.sentences
    law = report.described.laws[0]
    assert entry_of(law) == ("input", "pump_a", ("pump_a",), "heat")
    assert law.numbers["time"].value == pytest.approx(4.0, rel=0.05)
    assert is_confirmed(report)


def test_a_force_at_a_place_of_an_outside_simulator_is_found():
    """A brake that begins at 1 rad/s, one way only: position, speed and command are weighed."""
    brake = parse_expression("-size*max(v - 1.0, 0)", OF_FORCES)
    study = scenes.recorded(Term("hinge", brake, 0.15, scale=3.0))
    study = replace(study, runs=tuple(r for r in study.runs if r.name in ("sine_a", "steps_b")))
    made = setup_of(study)
    problem = Problem(made.model, study.fit_runs, WhiteNoise(study.channels))
    start = linearization_at(problem, np.zeros(problem.num_base))
    with few_laws():
        laws = find_laws([gauss_newton(problem, start)[0]], made.laws, silent)
    best = laws.screened[0]
    assert (best.entry.words, best.variable.name) == ("force at hinge", "speed at hinge")
    law = laws.laws[0]
    assert law.form == "threshold" and law.unit == "N m s/rad"
    block = made.laws.block(law)
    assert block["at"] == "force"
    extended = made.laws.setup_with([block])
    (effect,) = [e for e in extended.effects if e.name == law.name]
    problem = Problem(extended.model, study.fit_runs, WhiteNoise(study.channels), (effect,))
    at = np.zeros(problem.num_base + 1)
    at[-1] = 1.0  # at its usual size
    fit, _ = gauss_newton(problem, linearization_at(problem, at))
    assert fit.values[law.name] == pytest.approx(-0.15, rel=0.05)
    assert fit.values[f"threshold_of_{law.name}"] == pytest.approx(1.0, abs=0.05)
