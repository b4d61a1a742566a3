"""Two large causes that drive the plain model far from its data sheet."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.judge import decision_of
from diffsim.diagnose.search import search as searching
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.from_prior import FROM_PRIOR, LEAST_REFITS
from diffsim.diagnose.search.search import _fit_from_prior, begin, search_sets
from diffsim.diagnose.search.simulations import NONE, Simulations
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.systems.registry import setup_of
from tests.diagnose import toy

G, STEP, LATE, FRICTION = 9.81, 0.02, 0.07, 0.6
T = STEP * np.arange(200)
ONLY = [
    *("dry_friction", "viscous_friction", "friction_along_stroke"),
    *("delay", "lag", "dead_band", "command_gain", "slow_share"),
    *("sensor_delay_of_position", "sensor_delay_of_angle"),
    *("sensor_lag_of_position", "sensor_drift_of_position", "sensor_scale_of_angle"),
]
MODEL = {
    "system": "ode",
    "parameters": {
        "M": {"value": 1.2, "percent": 3},
        "m": {"value": 0.25, "percent": 3},
        "L": {"value": 0.4, "percent": 2},
        "c": {"value": 1.0, "percent": 50},
    },
    "inputs": [{"name": "force", "held": True}],
    "states": {"x": 0, "v": 0, "q": 0, "w": 0},
    "define": {
        "push": "force - c*v",
        "a": f"(push + m*sin(q)*(L*w**2 + {G}*cos(q)))/(M + m*sin(q)**2)",
    },
    "rates": {"x": "v", "v": "a", "q": "w", "w": f"-(a*cos(q) + {G}*sin(q))/L - 0.02*w"},
    "readings": {"x": "x", "angle": "q"},
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "M", "force": "push"}],
    "effects": {"only": ONLY},
    "effort": {"max_effects": 2, "num_refits": 2, "max_rounds": 2},
}
FORCES = {
    "sine": 4.0 * np.sin(3.1 * T),
    "square": np.where(np.sin(2.2 * T + 0.3) > 0.0, 3.0, -3.0),
    "multi": 2.0 * np.sin(1.7 * T) + 2.0 * np.sin(5.3 * T + 1.0),
    "sweep": 4.0 * np.sin(2.0 * np.pi * (0.2 + 0.12 * T) * T),
}


def record(force: np.ndarray) -> np.ndarray:
    """Position and angle of a cart that rubs, as a camera shows them that is late: from rest that
    is a late force, exactly."""

    def rates(s: float, y: np.ndarray) -> tuple[float, ...]:
        _, v, q, w = y
        push = force[min(int(s / STEP + 1e-9), len(T) - 1)] if s >= 0.0 else 0.0
        push -= 0.8 * v + FRICTION * np.tanh(v / 0.01)
        a = (push + 0.25 * np.sin(q) * (0.4 * w * w + G * np.cos(q))) / (
            1.2 + 0.25 * np.sin(q) ** 2
        )
        return v, a, w, -(a * np.cos(q) + G * np.sin(q)) / 0.4 - 0.02 * w

    at = np.maximum(T - LATE, 0.0)
    span, options = (0.0, T[-1]), {"max_step": 0.005, "rtol": 1e-7}
    seen = solve_ivp(rates, span, np.zeros(4), dense_output=True, **options)
    return seen.sol(at)[[0, 2]].T


def cart() -> Study:
    rng = np.random.default_rng(5)
    channels = (Channel("x", "m", "position", 1e-3), Channel("angle", "rad", "angle", 5e-3))
    runs = []
    for order, (name, force) in enumerate(FORCES.items()):
        noise = rng.normal(size=(len(T), 2)) * [1e-3, 5e-3]
        use = "test" if name == "sweep" else "fit"
        measured = record(force) + noise
        runs.append(Run(name, T, measured, {"force": force}, name, order, use))
    return Study("cart", "ode", channels, tuple(runs), model=MODEL)


@pytest.mark.story  # a whole diagnosis of a cart
def test_two_large_causes_are_named_although_neither_helps_alone():
    study = cart()
    setup = setup_of(study)
    report = diagnose(study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns)
    assert report.verdict == "named", report.sentences
    assert set(report.named) == {"dry_friction", "delay"}, report.sentences
    (late,) = next(c.size for c in report.causes if c.name == "delay").values()
    assert late.low <= LATE <= late.high
    (rubs,) = next(c.size for c in report.causes if c.name == "dry_friction").values()
    assert abs(rubs.value - FRICTION) < 0.03
    masses = {row.name: row for row in report.base if row.name in ("M", "m")}
    assert all(abs(row.pull) < 2.0 for row in masses.values())


def begun(effort: SearchSettings, effects=(toy.BIAS, toy.DELAY, toy.DRAG)) -> Search:
    """A search of the toy that has not fitted any set."""
    study = toy.generate(4, {"delay": 0.03})
    settings = DiagnosisSettings(search=effort)
    null = null_fit(Case(study, toy.model(study.runs), effects, (), settings))
    steps = null.case.model.simulations.steps
    null = replace(null, case=replace(null.case, searching=steps))
    return begin(null, Simulations(null.wide))


def table_of(search: Search) -> float:
    """Weighted steps that slopes of all causes are taken to cost; half of a budget is for them and
    for the fits from there."""
    wide = search.wide
    return wide.cost_of_table()


@pytest.mark.parametrize("first", [frozenset(), frozenset({0, 2})], ids=["plain", "several"])
def test_a_single_cause_that_takes_most_is_fitted_before_sets_grow(first, monkeypatch):
    """An elastic coupling was said to be two lags: by slopes it took two thirds of the misfit, and
    four others more; its own fit would have left nothing. Another one was fitted too late."""
    search = begun(SearchSettings(max_effects=2))
    late = frozenset({1})
    search = searching.refit(search, first)
    # what slopes rank behind the set is no neighbor that is fitted
    monkeypatch.setattr(type(search), "neighbors", lambda search, members: [])
    monkeypatch.setattr(searching, "has_left_prior", lambda fit: False)
    monkeypatch.setattr(searching, "_refit_rivals", lambda search, *_: search)
    after = search_sets(search)
    assert late in after.fits and frozenset({0}) not in after.fits
    assert decision_of(after).best == late
    # within the budget only
    case = replace(search.null.case, searching=-np.inf)
    assert late not in search_sets(replace(search, null=replace(search.null, case=case))).fits


@pytest.fixture
def left(monkeypatch):
    """Every fit of the plain model counts as far from its data sheet, and no cause takes most."""
    monkeypatch.setattr(searching, "has_left_prior", lambda fit: True)
    monkeypatch.setattr(searching, "MOST_OF_PLAIN", 0.0)


def test_sets_from_the_data_sheet_that_a_budget_leaves_out_are_counted(left):
    whole = _fit_from_prior(begun(SearchSettings()))
    assert not whole.is_cut_short and len(whole.fits) > 1
    short = _fit_from_prior(begun(SearchSettings(refit_steps=2.0 * 1.001 * table_of(whole))))
    # two are fitted in any case: of a table of which nothing is fitted nobody has anything
    assert short.num_late == len(whole.fits) - 3 and len(short.fits) == 3
    assert short.is_cut_short


def test_what_one_cause_does_is_not_left_to_two_that_slopes_promise(left, monkeypatch):
    """A controller was late: slopes far off promised a late sensor beside it, and the pair spent
    what was for the cause alone."""
    others = set(_fit_from_prior(begun(SearchSettings())).fits)
    monkeypatch.undo()
    search = _fit_from_prior(begun(SearchSettings()))
    assert set(search.fits) == {NONE, frozenset({1})} < others and search.num_late == 0


def fits_in_order(monkeypatch, effort: SearchSettings) -> list[tuple[frozenset[int], float]]:
    """Sets that are fitted from the data sheet, each with the steps after which its fit ends."""
    seen = []
    fitted = Simulations.fitted_from

    def noting(made, members, start, best_cost, begin=None, most=np.inf):
        seen.append((members, most))
        return fitted(made, members, start, best_cost, begin, most)

    monkeypatch.setattr(Simulations, "fitted_from", noting)
    _fit_from_prior(begun(effort))
    return seen


def test_the_second_set_that_is_fitted_there_shares_no_cause_with_the_first(left, monkeypatch):
    (first, _), (second, _), *_ = fits_in_order(monkeypatch, SearchSettings())
    assert second and not first & second


def test_no_fit_of_a_set_takes_the_turn_of_the_others(left, monkeypatch):
    budget = 1e9
    for _, most in fits_in_order(monkeypatch, SearchSettings(refit_steps=budget)):
        assert most == FROM_PRIOR / LEAST_REFITS * budget


def test_slopes_at_the_data_sheet_after_which_no_set_could_be_fitted_are_not_made(left):
    search = begun(SearchSettings())
    short = begun(SearchSettings(refit_steps=0.999 * table_of(search)))
    before = short.steps
    after = _fit_from_prior(short)
    assert after.steps == before and after.num_late == 1 and after.is_cut_short


def test_sets_of_an_earlier_round_are_weighed_again_though_the_budget_is_spent(left):
    search = begun(SearchSettings(refit_steps=2.0 * 1.001 * table_of(begun(SearchSettings()))))
    made = Simulations(search.wide).under(search.null)
    kept = _fit_from_prior(begun(SearchSettings())).simulations.fitted
    again = replace(search, simulations=replace(search.simulations, fitted={**made.fitted, **kept}))
    after = _fit_from_prior(again)
    assert not after.is_cut_short and set(after.fits) == set(kept)


def test_slopes_at_the_data_sheet_that_are_too_dear_are_counted(left):
    search = _fit_from_prior(begun(SearchSettings(scan_steps=1.0)))
    assert set(search.fits) == {NONE} and search.num_late == 1 and search.is_cut_short
    # what an earlier round has simulated costs nothing
    made = _fit_from_prior(begun(SearchSettings())).simulations
    known = replace(search, num_late=0, simulations=replace(made, scan_steps=0))
    assert _fit_from_prior(known).simulations.at_prior is made.at_prior


def test_scans_at_the_data_sheet_that_a_budget_leaves_out_are_counted(left):
    kinked = replace(toy.DRAG, scanned=True)
    effects = (toy.BIAS, kinked)
    search = _fit_from_prior(begun(SearchSettings(scan_points=0), effects))
    places = {place for place, _, _ in search.simulations.scans_late}
    assert " at the data sheet" in places and search.is_cut_short
    assert not search.simulations.place and not search.simulations.scans
    assert not _fit_from_prior(begun(SearchSettings(), effects)).is_cut_short


def test_a_search_that_runs_out_of_moves_is_cut_short(monkeypatch):
    monkeypatch.setattr(searching, "has_left_prior", lambda fit: False)
    assert not search_sets(begun(SearchSettings())).is_cut_short
    short = search_sets(begun(SearchSettings(max_rounds=1)))
    assert short.num_late == 1 and short.is_cut_short
