"""What the page of the fish tail claims."""

from __future__ import annotations

import pytest

from diffsim.data import import_study
from diffsim.diagnose import diagnose
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.measured import data_folder

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def given():
    data_folder("fish_tail")
    study = import_study("fish_tail")
    return study, setup_of(study)


def test_slow_pressure_explains_most_of_the_misfit(given):
    study, setup = given
    assert not study.test_runs  # one recording: no gain can be measured

    def chi2(*names):
        chosen = [e for e in setup.effects if e.name in names]
        return fit(setup.model, study.fit_runs, study.channels, effects=chosen).chi2

    null = chi2()
    assert chi2("slow_fill") < 0.1 * null
    assert chi2("slow_compliance") < 0.1 * null  # the twin


@pytest.mark.slow
def test_verdict(given):
    """What the pipeline says; the page says why it is half believed."""
    study, setup = given
    report = diagnose(
        study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns, settings=setup.settings
    )
    gates = {g.name: g.passed for g in report.gates}
    assert gates["time_step"] and not gates["held_out"]
    assert report.verdict == "named"
    assert set(report.named) == {"slow_fill", "pressure_softening"}
    assert report.gain is None
    # at a second mode it stopped with 330 and the damping ratio on its bound
    assert report.chi2_best < 0.7 * report.num_samples
    assert report.best.converged and not report.best.at_bound
