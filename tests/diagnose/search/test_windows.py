"""Whole runs may be too hard for a first fit; short ones lead to them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.search import fit as fit_module
from diffsim.diagnose.search.fit import Case, cut, first_fit, null_fit
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import DiagnosisSettings, Parameter, Problem, SimModel, WhiteNoise
from diffsim.identify.linearization import linearization_at

TIME = np.linspace(0.0, 10.0, 201)
CHANNEL = (Channel("a", "m", "position", sd=0.05),)


@dataclass
class Swing:
    """sin(omega t): beyond some periods, the misfit has a minimum at every beat."""

    omega: torch.Tensor
    run: Run
    longest_s: float = np.inf

    def simulate(self):
        if self.run.time_s[-1] > self.longest_s and abs(float(self.omega) - 6.0) > 0.3:
            raise DiffsimError("the motion leaves the range of numbers")
        return torch.sin(self.omega * torch.from_numpy(self.run.time_s))[:, None]


def problem(longest_s=np.inf, omega=6.0):
    rng = np.random.default_rng(0)
    runs = [
        Run(
            n,
            TIME,
            np.sin(omega * TIME)[:, None] + 0.05 * rng.normal(size=(201, 1)),
            {"u": TIME},
            n,
        )
        for n in "ab"
    ]
    base = [Parameter("omega", 7.2, 1.0, "rad/s")]
    model = SimModel(lambda v, run, numerics: Swing(v["omega"], run, longest_s), base, "swing")
    return Problem(model, tuple(runs), WhiteNoise(CHANNEL))


def test_growing_windows_find_a_frequency_that_whole_runs_do_not():
    whole = problem()
    stuck, _ = gauss_newton(whole, linearization_at(whole, np.zeros(1)))
    assert abs(stuck.values["omega"] - 6.0) > 0.3
    found, at = first_fit(whole, (0.25, 0.5))
    assert found.values["omega"] == pytest.approx(6.0, abs=0.01)
    assert found.num_samples == stuck.num_samples and len(at.record) == 402
    assert first_fit(whole, ())[0].x == pytest.approx(stuck.x)


@pytest.mark.parametrize(("chi2", "prior", "wins"), [(-9.0, 5.0, True), (-9.0, 15.0, False)])
def test_of_two_ends_the_one_of_less_cost_is_kept(chi2, prior, wins, monkeypatch):
    whole = problem()
    stuck, at = gauss_newton(whole, linearization_at(whole, np.zeros(1)))
    other = replace(stuck, chi2=stuck.chi2 + chi2, prior=stuck.prior + prior)
    monkeypatch.setattr(fit_module, "grown", lambda *_: (other, at))
    assert (first_fit(whole, (0.5,))[0] is other) == wins


def test_a_motion_that_breaks_down_is_fitted_where_it_does_not():
    whole = problem(longest_s=6.0)
    with pytest.raises(DiffsimError, match="range of numbers"):
        first_fit(whole, ())
    found, _ = first_fit(whole, (0.25, 0.5))
    assert found.values["omega"] == pytest.approx(6.0, abs=0.01)


def test_a_good_fit_pays_for_no_windows():
    whole = problem(omega=7.1)
    before = whole.model.simulations.count
    plain, _ = gauss_newton(whole, linearization_at(whole, np.zeros(1)))
    paid = whole.model.simulations.count - before
    found, _ = first_fit(whole, (0.25, 0.5))
    assert whole.model.simulations.count - before == 2 * paid
    np.testing.assert_array_equal(found.x, plain.x)


def test_a_model_is_asked_for_shorter_windows_of_its_own():
    class Shooting(SimModel):
        def __init__(self, length_s):
            super().__init__(self.made, [Parameter("omega", 7.2, 1.0, "rad/s")], "shooting")
            self.length_s = length_s

        def made(self, values, run, numerics):
            if self.length_s > 1.0:
                raise DiffsimError("windows are too long")
            return Swing(torch.as_tensor(7.2).double() + 0.0 * values["omega"], run)

        def shortened(self, runs):
            return Shooting(0.5 * self.length_s) if self.length_s > 0.3 else None

    whole = replace(problem(omega=7.2), model=Shooting(3.0))
    found, _ = first_fit(whole, ())
    assert found.problem.model.length_s == 0.75
    study = Study("swing", "soft_body", CHANNEL, whole.runs)
    null = null_fit(Case(study, Shooting(3.0), (), (), DiagnosisSettings()))
    assert null.case.model.length_s == null.fit.problem.model.length_s == 0.75


def test_a_cut_run_is_its_beginning():
    run = problem().runs[0]
    part = cut(run, 0.25)
    assert len(part.time_s) == len(part.measured) == len(part.command["u"]) == 51
    np.testing.assert_array_equal(part.measured, run.measured[:51])
    assert len(cut(run, 1e-6).time_s) == 8
