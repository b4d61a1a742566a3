"""Laws by the slopes of a fit that holds them, and where such a fit begins."""

import math

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose.discover import stage
from diffsim.diagnose.discover.follow import follow
from diffsim.diagnose.discover.forms import fit_forms
from diffsim.diagnose.discover.screen import screen_laws
from diffsim.diagnose.search.fit import silent
from diffsim.diagnose.search.search import has_left_prior
from diffsim.identify import fit
from diffsim.systems.registry import setup_of

FORCE, NOISE = np.linspace(0.5, 6.0, 80), 1e-4  # [N], [m]
MODEL = {
    "system": "bench",
    "parameters": {"stiffness": {"value": "100 N/m", "percent": 2}},
    "readings": {"stretch": "force/stiffness"},
}


def plain_fit(hidden, stiffness=100.0):
    """The plain model's fit of a spring whose reading holds something else, and its law port."""
    runs = []
    for k, name in enumerate("ab"):
        force = FORCE[:: 1 - 2 * k] * (1.0 + 0.1 * k)
        noise = NOISE * np.random.default_rng(k).standard_normal(len(force))
        seen = force / stiffness + hidden(force) + noise
        runs.append(Run(name, np.arange(80.0), seen[:, None], {"force": force}, name, k))
    channels, commands = (Channel("stretch", "m", "position", sd=NOISE),), (Command("force", "N"),)
    setup = setup_of(
        Study("spring", "bench", channels, tuple(runs), commands=commands, model=MODEL)
    )
    return fit(setup.model, runs, channels), setup.laws


def best_law(plain, port):
    """The screen, and the law of the force at the reading, fitted."""
    screen = screen_laws(follow(plain, port), port, silent, np.inf)
    law = next(
        c
        for c in screen.found
        if c.entry.kind == "reading" and c.variable.name == "force" and not c.basis.wave
    )
    fitted = stage._fit_law(screen, plain, law, port, (), math.inf)
    assert fitted is not None
    return screen, fitted


def test_slopes_at_a_fit_tell_of_a_law_at_a_reading_what_those_along_the_record_tell():
    """Bumps are linear there: both hold the same parabola, and ask for the same formula."""
    screen, fitted = best_law(*plain_fit(lambda force: 2e-3 * np.exp(-0.6 * force)))
    along = screen.misfit_of(fitted.candidate)
    there = screen.misfit_at(fitted.fit, fitted.candidate, fitted.curve)
    forms = [fit_forms(told)[0] for told in (along, there)]
    assert forms[0].form is forms[1].form and forms[0].form.name == "exponential"
    rates = [form.numbers["rate"][0] for form in forms]
    assert rates == pytest.approx([-0.6, -0.6], abs=0.05)
    assert forms[1].size == pytest.approx(forms[0].size, rel=0.05)


def test_a_law_may_take_all_that_laws_may_cost(monkeypatch):
    """Two tanks' best law, beside a cause, was cut short by a count of records, and lost."""
    plain, port = plain_fit(lambda force: 2e-3 * np.exp(-0.6 * force))
    screen, fitted = best_law(plain, port)
    monkeypatch.setattr(stage, "LAW_RECORDS", 0.0)
    ends = [
        law.fit.ended
        for most_steps in (0.0, 1e3 * plain.problem.cost())
        if (law := stage._fit_law(screen, plain, fitted.candidate, port, (), most_steps))
    ]
    assert ends == ["budget", "converged"]


def test_a_first_step_that_is_too_long_is_shortened():
    """Asked to go ten times as far, a fit begins where the cost is lowest on the way."""
    plain, port = plain_fit(lambda force: 2e-3 * np.exp(-0.6 * force))
    _, fitted = best_law(plain, port)
    problem = fitted.fit.problem
    stays = np.concatenate([plain.x, np.zeros(len(fitted.fit.x) - len(plain.x))])
    way = problem.scaled(fitted.fit.x) - problem.scaled(stays)
    began = problem.scaled(stage._begin(problem, plain, problem.scaled(stays) + 8.0 * way))
    assert began == pytest.approx(problem.scaled(fitted.fit.x), abs=1e-6)
    back = stage._begin(problem, plain, problem.scaled(stays) - 8.0 * way)
    assert back == pytest.approx(stays, abs=1e-12)  # each part of it is worse than to stay


@pytest.mark.parametrize(("stiffness", "has_left"), [(100.5, False), (160.0, True)])
def test_laws_are_weighed_at_the_data_sheet_that_a_fit_has_left(stiffness, has_left):
    plain, _ = plain_fit(lambda force: 0.0 * force, stiffness)
    assert has_left_prior(plain) == has_left
    found = stage.at_data_sheet(plain)
    assert len(found) == has_left
    for at in found:
        assert at.values["stiffness"] == 100.0 and not at.x.any()
        missing = np.concatenate([run.measured[:, 0] - run.command["force"] / 100.0
                                  for run in at.problem.runs])  # fmt: skip
        assert at.residual == pytest.approx(missing / NOISE)
        slopes = -np.concatenate([run.command["force"] for run in at.problem.runs]) / 100.0**2
        unit = at.problem.model.base[0].sd  # of a coordinate, [N/m] or of the logarithm
        slope = slopes * (100.0 * unit if at.problem.model.base[0].log else unit) / NOISE
        assert at.jacobian[:, 0] == pytest.approx(slope, rel=1e-4)
