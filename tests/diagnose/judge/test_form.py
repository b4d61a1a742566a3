"""A weak second cause is not named: it may be what the first one's form has wrong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.judge import Decision
from diffsim.diagnose.judge.stand_ins import form_of, without_forms
from diffsim.diagnose.say import assemble
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.diagnose.search.search import refit
from diffsim.identify import DiagnosisSettings, SearchSettings
from tests.diagnose import linear

NUM = 400
TIME = np.linspace(0.0, 8.0, NUM)
SHAPES = np.column_stack([np.sin(TIME), np.sin(TIME) + 0.5 * np.cos(3.0 * TIME)])


def fit(strong, weak, families=("damping", "damping")):
    """A fit with a base parameter and two effects of these lengths, in noise sd."""
    slopes = np.column_stack([np.ones(NUM), SHAPES])
    effects = [
        SimpleNamespace(name=n, family=f)
        for n, f in zip(("first_law", "second"), families, strict=True)
    ]
    x = np.array([0.0, strong, weak]) / np.linalg.norm(SHAPES[:, 0])
    problem = SimpleNamespace(
        effects=effects,
        num_base=1,
        stretch=lambda x: np.ones(len(x)),
        scaled=lambda x: x,
        columns_of=lambda e: [1 + next(i for i, other in enumerate(effects) if other is e)],
    )
    return SimpleNamespace(problem=problem, jacobian=slopes, x=x, residual=np.zeros(NUM))


def decision(verdict="named"):
    return Decision(verdict, frozenset({3, 7}), (), None, 1.0)


def test_a_weak_second_law_may_be_the_form_of_the_first():
    assert form_of(fit(180.0, 8.0), {}) == {1: "another form of first law"}
    decided = without_forms(decision(), fit(180.0, 8.0))
    assert decided.verdict == "ambiguous"
    assert decided.forms == {7: "another form of first law"}
    assert decided.rivals == (Hypothesis(frozenset({3})),)


def test_a_second_law_that_stands_out_is_named():
    assert form_of(fit(180.0, 60.0), {}) == {}
    assert without_forms(decision(), fit(180.0, 60.0)) == decision()


OTHER = ("damping", "sensor")


def test_another_family_below_the_noise_may_be_the_form_of_what_acts_there():
    """A play of 0.4 noise sd was certain beside friction of 600 whose time steps were too long."""
    assert form_of(fit(240.0, 8.0, OTHER), {}) == {1: "another form of first law"}


def test_another_family_stands_above_the_noise():
    assert form_of(fit(2400.0, 80.0, OTHER), {}) == {}


def test_another_family_stands_where_the_first_does_little(monkeypatch):
    assert form_of(fit(60.0, 8.0, OTHER), {}) == {}
    turns = np.sin(np.pi * TIME)
    apart = np.column_stack([turns * (TIME < 4.0), turns * (TIME >= 4.0)])
    monkeypatch.setitem(globals(), "SHAPES", apart)
    assert form_of(fit(2400.0, 8.0, OTHER), {}) == {}


@pytest.mark.parametrize(("weak", "form"), [(8.0, False), (2.0, True)])
def test_a_fit_without_it_tells_where_slopes_do_not_reach(weak, form):
    """Without dry friction a table lacked 35 sd by slopes, as if masses and motor went to zero with
    it, and 870 in a fit: "another form of delay". Sizes that may be zero are within reach."""
    part = SimpleNamespace(residual=np.full(NUM, 3.0), x=np.zeros(2), ended="converged")
    assert form_of(fit(240.0, weak, OTHER), {}) == {1: "another form of first law"}
    assert bool(form_of(fit(240.0, weak, OTHER), {}, {1: part})) == form
    decided = without_forms(decision(), fit(240.0, weak, OTHER), parts={frozenset({3}): part})
    assert (7 in decided.forms) == form
    cut = SimpleNamespace(**{**vars(part), "ended": "budget"})
    decided = without_forms(decision(), fit(240.0, weak, OTHER), parts={frozenset({3}): cut})
    assert 7 in decided.forms  # a fit that ended early lacks more than it must


def test_what_refining_could_be_is_not_certain():
    done = fit(60.0, 16.0, OTHER)
    weak = done.jacobian[:, 2] * done.x[2]
    assert form_of(done, {"time_step": -0.5 * weak}) == {1: "too coarse a time step"}
    assert form_of(done, {"time_step": 0.2 * weak}) == {}


def test_what_nobody_names_stays():
    assert without_forms(decision("unknown"), fit(180.0, 8.0)) == decision("unknown")


def test_a_set_without_several_forms_is_fitted(monkeypatch):
    """The search need not have come by: a diagnosis of rotors ended in a KeyError."""
    laws = [linear.line(name) for name in ("first", "second", "third")]
    sizes = dict(zip(laws, (9.0, 4.0, 2.0), strict=True))
    study = Study("laws", "copter", linear.CHANNELS, tuple(runs_of(sizes)))
    seen = []

    def without_two(decision, fit, unrefined, stepped, parts):
        assert decision.best == {0, 1, 2}
        rest = Hypothesis(frozenset({2}))
        return replace(decision, verdict="ambiguous", rivals=(rest,), forms={0: "", 1: ""})

    def refitted(search, members):
        seen.append(Hypothesis(members) in search.posteriors)
        return refit(search, members)

    monkeypatch.setattr(assemble, "without_forms", without_two)
    monkeypatch.setattr(assemble, "refit", refitted)
    settings = DiagnosisSettings(search=SearchSettings(num_refits=1))
    report = diagnose(study, linear.model(), tuple(laws), seed=0, settings=settings)
    assert seen == [False]
    assert ("third",) in report.rivals


def runs_of(sizes):
    for k in range(4):
        run, model = linear.run(f"r{k}", k), linear.model()
        given = {effect: torch.tensor([size]).double() for effect, size in sizes.items()}
        clean = model.predict(run, torch.zeros(2, dtype=torch.float64), given)
        yield replace(run, measured=run.measured + clean.numpy())
