from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, linalg, optimize

from diffsim.data.study import Study
from diffsim.diagnose.checks.noise import noise_floor
from diffsim.diagnose.search.evidence import AMPLITUDES, Hypothesis, LaplaceEvidence, unrealized
from diffsim.diagnose.search.fit import Case, Null
from diffsim.diagnose.search.search import begin
from diffsim.diagnose.search.simulations import Simulations
from diffsim.identify import DiagnosisSettings, SimModel, Unknown, UnknownDrift, fit
from diffsim.identify.linearization import linearization_at
from tests.diagnose import linear


def constant(y):
    """What ``evidence`` leaves out."""
    return -0.5 * len(y) * np.log(2 * np.pi)


def linearized(problem, x, unknowns, num_families):
    """At x, with the responses of unknown causes."""
    responses = [u.responses(problem, x) for u in unknowns]
    return LaplaceEvidence(problem, x, *problem.linearize(x), responses, num_families)


def integrated(y, base, sizes, signed):
    """ln p(y) without its constant: base parameters analytically, each size on a grid of its
    standardized coordinate.

    Args:
        y: Whitened data, (N,).
        base, sizes: Whitened columns of base parameters and of scaled sizes.
        signed: Whether each size may be negative.
    """
    inverse = np.linalg.inv(np.eye(len(y)) + base @ base.T)
    gram, b = sizes.T @ inverse @ sizes, sizes.T @ inverse @ y
    count = {0: 1, 1: 40001, 2: 1601, 3: 161}[sizes.shape[1]]
    x = [np.linspace(-7.0 if is_signed else 0.0, 7.0, count) for is_signed in signed]
    grids = np.meshgrid(*x, indexing="ij")
    u = [np.sinh(1.5 * g) / 1.5 for g in grids]
    logs = np.zeros(grids[0].shape if grids else ())
    for i, g in enumerate(grids):
        logs = logs + b[i] * u[i] - 0.5 * g * g - 0.5 * np.log(2.0 * np.pi)
        logs += 0.0 if signed[i] else np.log(2.0)
        for j in range(len(grids)):
            logs = logs - 0.5 * gram[i, j] * u[i] * u[j]
    peak = logs.max()
    area = np.exp(logs - peak)
    for points in reversed(x):
        area = integrate.simpson(area, x=points, axis=-1)
    _, log_det = np.linalg.slogdet(np.eye(len(y)) + base @ base.T)
    return peak + np.log(area) - 0.5 * (y @ inverse @ y) - 0.5 * log_det


def pushed(push, name="push"):
    """Runs that hold a force of this size [N]."""
    return [
        replace(r, measured=r.measured + push * linear.shapes(name, r).numpy()[..., 0])
        for r in (linear.run("r1", 1), linear.run("r2", 2))
    ]


@pytest.mark.reference
@pytest.mark.parametrize("push", [0.0, 2.0])
def test_several_sizes_against_quadrature(push):
    """One size is exact; the coupling of several that say little costs a quarter of a nat."""
    effects = (linear.line("push"), linear.line("wind", components=("x", "y")))
    runs = pushed(push)
    lin = linearized(linear.problem(effects, runs), np.zeros(5), (), 1)
    y, a = linear.matrices(effects, runs)
    for members, columns, atol in [
        ((), [], 1e-6),
        ((0,), [2], 1e-6),
        ((1,), [3, 4], 0.3),
        ((0, 1), [2, 3, 4], 0.3),
    ]:
        truth = integrated(y, a[:, :2], a[:, columns], [True] * len(columns))
        found = lin.weigh(Hypothesis(frozenset(members))).nats
        np.testing.assert_allclose(found, truth, atol=atol)


@pytest.mark.reference
@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("push", [-0.8, -0.1, 0.0, 0.3, 1.5, 4.0, 40.0])
def test_one_size_against_a_brute_force_integral(push, signed):
    """Typical is 0.4: the last are ten and a hundred times as large."""
    effect, runs = linear.line("push", signed=signed), pushed(push)
    y, a = linear.matrices((effect,), runs)
    truth = integrated(y, a[:, :2], a[:, 2:], [signed])
    # linearized away from the answer: in a linear problem it must not matter
    starts = ([0.3, -0.2, 0.0], [0.3, -0.2, 0.7]) if push < 10.0 else ([0.0, 0.0, 2.7],)
    for x in map(np.array, starts):
        lin = linearized(linear.problem((effect,), runs), x, (), 1)
        found = lin.weigh(Hypothesis(frozenset({0}))).nats
        np.testing.assert_allclose(found, truth, rtol=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("times", [1.0, 3.0, 10.0, 100.0])
def test_a_size_far_above_the_typical_one_costs_a_few_nats(times):
    """Evidence for the right cause less that of a prior of the same size that knows it."""
    effect, runs = linear.line("push"), pushed(0.4 * times)
    x = np.arcsinh(times) / 1.5
    lin = linearized(linear.problem((effect,), runs), np.array([0.0, 0.0, x]), (), 1)
    posterior = lin.weigh(Hypothesis(frozenset({0})))
    np.testing.assert_allclose(posterior.x[2], x, atol=0.35 / times)
    wide = linear.problem((replace(effect, typical=0.4 * times),), runs)
    known = linearized(wide, np.zeros(3), (), 1)
    lost = known.weigh(Hypothesis(frozenset({0}))).nats - posterior.nats
    # the narrower prior is the better one for small sizes: its height at the size decides
    assert lost < {1.0: 0.1, 3.0: 0.5, 10.0: 2.0, 100.0: 6.0}[times]


@pytest.mark.reference
def test_the_linear_optimum_far_away_is_that_of_a_fit():
    """From a center where the size is zero, in two valleys."""
    effects, runs = (linear.line("push"), linear.line("pull", signed=False)), pushed(4.0)
    posterior = linearized(linear.problem(effects, runs), np.zeros(4), (), 1).weigh(
        Hypothesis(frozenset({0, 1}))
    )
    best = fit(linear.model(), runs, linear.CHANNELS, effects=effects, start=np.full(4, 0.5))
    np.testing.assert_allclose(posterior.x, best.x, atol=1e-3)
    np.testing.assert_allclose(posterior.chi2, best.chi2, rtol=1e-6)
    np.testing.assert_allclose(posterior.sd[0], np.sqrt(best.covariance[0, 0]), rtol=0.02)
    assert best.values["push"] == pytest.approx(4.0, abs=4.0 * best.sd["push"])


def bounded(problem, low, high):
    """With bounds of the base parameters, in coordinates; they must hold the prior's center."""
    base = [
        replace(p, lower=p.value + p.sd * a, upper=p.value + p.sd * b)
        for p, a, b in zip(problem.model.base, low, high, strict=True)
    ]
    return replace(problem, model=SimModel(problem.model.build, base))


def moved(mass=0.0, gain=0.0):
    """Runs whose base parameters lie off the prior's center, coordinates."""
    return [
        replace(
            r,
            measured=r.measured
            + mass * 0.7 * linear.shapes("mass", r).numpy()[..., 0]
            + gain * 1.5 * linear.shapes("gain", r).numpy()[..., 0],
        )
        for r in (linear.run("r1", 1), linear.run("r2", 2))
    ]


@pytest.mark.reference
@pytest.mark.parametrize("beyond", [-2.0, -0.3, 0.0, 1.0, 6.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_bound_against_a_brute_force_integral(beyond, side):
    """Over mass by quadrature, over the others analytically; the optimum lies ``beyond`` posterior
    standard deviations beyond the bound."""
    from scipy import stats

    runs = moved(mass=4.0 * side)
    y, a = linear.matrices((), runs)
    inverse = np.linalg.inv(a.T @ a + np.eye(2))
    mean, sd = (inverse @ a.T @ y)[0], np.sqrt(inverse[0, 0])
    bound = mean - side * beyond * sd
    others = stats.multivariate_normal(cov=np.eye(len(y)) + a[:, 1:] @ a[:, 1:].T)

    def log(x):
        return others.logpdf(y - a[:, 0] * x) + stats.norm.logpdf(x)

    near = min(mean, bound) if side > 0.0 else max(mean, bound)
    edges = sorted([bound, near - side * 14.0 * sd])
    points = np.linspace(*edges, 60)
    peak = max(log(x) for x in points)
    area, _ = integrate.quad(
        lambda x: np.exp(log(x) - peak), *edges, epsabs=1e-13, limit=500, points=points[1:-1]
    )
    low, high = np.full(2, -np.inf), np.full(2, np.inf)
    (high if side > 0.0 else low)[0] = bound
    problem = bounded(linear.problem((), runs), low, high)
    posterior = linearized(problem, np.array([0.3, -0.2]), (), 1).weigh(Hypothesis())
    np.testing.assert_allclose(posterior.nats + constant(y), peak + np.log(area), rtol=1e-6)
    assert low[0] - 1e-12 <= posterior.x[0] <= high[0] + 1e-12


@pytest.mark.reference
@pytest.mark.parametrize("limits", [(2.0, np.inf), (2.0, 1.0), (3.9, 3.9)])
def test_the_optimum_within_several_bounds(limits):
    runs = moved(4.0, 4.0)
    y, a = linear.matrices((), runs)
    problem = bounded(linear.problem((), runs), np.full(2, -np.inf), limits)
    posterior = linearized(problem, np.zeros(2), (), 1).weigh(Hypothesis())
    stacked, right = np.vstack([a, np.eye(2)]), np.concatenate([y, np.zeros(2)])
    truth = optimize.lsq_linear(stacked, right, (-np.inf, limits), method="bvls", tol=1e-12)
    np.testing.assert_allclose(posterior.x, truth.x, atol=1e-9)
    np.testing.assert_allclose(posterior.chi2, np.sum((y - a @ truth.x) ** 2), rtol=1e-9)


@pytest.mark.reference
@pytest.mark.parametrize("beyond", [(1.5, 2.5), (0.0, 0.0), (-1.0, 3.0)])
def test_two_bounds_against_the_normal_beyond_them(beyond):
    """Two are not exact: within a quarter of a nat here."""
    from scipy import stats

    runs = moved(4.0, 4.0)
    y, a = linear.matrices((), runs)
    inverse = np.linalg.inv(a.T @ a + np.eye(2))
    mean, sd = inverse @ a.T @ y, np.sqrt(np.diag(inverse))
    high = mean - beyond * sd
    problem = linear.problem((), runs)
    free = linearized(problem, np.zeros(2), (), 1).weigh(Hypothesis()).nats
    within = bounded(problem, np.full(2, -np.inf), high)
    held = linearized(within, np.zeros(2), (), 1).weigh(Hypothesis()).nats
    share = stats.multivariate_normal(mean=mean, cov=inverse).logcdf(high)
    np.testing.assert_allclose(held - free, share, atol=0.25)


class Given(Unknown):
    name = "given"

    def __init__(self, responses):
        self.h = responses

    def slopes(self, problem, x):
        return self.h

    def responses(self, problem, x):
        return self.h


@pytest.mark.reference
def test_unknown_against_the_marginal_normal_averaged_over_amplitudes():
    effects = (linear.line("push"),)
    y, a = linear.matrices(effects)
    h = np.random.default_rng(0).normal(size=(len(y), 7))
    unit = h / np.sqrt(np.sum(h**2) / len(y))
    lin = linearized(linear.problem(effects), np.zeros(3), (Given(h),), 1)
    for members, columns in [((), []), ((0,), [2])]:
        logs = [
            integrated(
                y, np.hstack([a[:, :2], amplitude * unit]), a[:, columns], [True] * len(columns)
            )
            for amplitude in AMPLITUDES
        ]
        truth = np.log(np.mean(np.exp(logs)))
        found = lin.weigh(Hypothesis(frozenset(members), 0)).nats
        np.testing.assert_allclose(found, truth, rtol=1e-6)


@pytest.mark.parametrize("low", [-np.inf, 0.4])
def test_the_optimum_beside_an_unknown_is_that_of_all_its_coefficients(low):
    y, a = linear.matrices(())
    h = np.random.default_rng(0).normal(size=(len(y), 7))
    linearization = linearized(linear.problem(), np.zeros(2), (Given(h),), 1)
    linearization.bounds = np.array([low, -np.inf]), np.full(2, np.inf)
    found = linearization.weigh(Hypothesis(frozenset(), 0))
    scaled = found.amplitude * h / np.sqrt(np.sum(h**2) / len(y))
    columns = np.vstack([np.hstack([a[:, :2], scaled]), np.eye(9)])
    bounds = np.r_[low, np.full(8, -np.inf)], np.full(9, np.inf)
    best = optimize.lsq_linear(columns, np.r_[y, np.zeros(9)], bounds, tol=1e-14).x
    np.testing.assert_allclose(found.x, best[:2], atol=1e-9)
    np.testing.assert_allclose(found.chi2, np.sum((y - columns[: len(y)] @ best) ** 2), rtol=1e-9)


def test_a_form_chosen_among_many_pays_for_the_choice():
    """By its price exactly, alone and beside others; a set without it pays nothing."""
    effects, runs = (linear.line("push"), linear.line("wind")), pushed(2.0)
    dear = (replace(effects[0], price=4.25), effects[1])
    free, paid = (
        linearized(linear.problem(e, runs), np.zeros(4), (UnknownDrift(0, "a"),), 3)
        for e in (effects, dear)
    )
    for members, unknown, price in [
        ((), None, 0.0),
        ((1,), None, 0.0),
        ((0,), None, 4.25),
        ((0, 1), None, 4.25),
        ((0,), 0, 4.25),
    ]:
        asked = Hypothesis(frozenset(members), unknown)
        np.testing.assert_allclose(free.weigh(asked).nats - paid.weigh(asked).nats, price)


def test_every_effect_and_unknown_pays_for_being_chosen():
    effects = (linear.line("push"), linear.line("pull"))
    h = np.random.default_rng(0).normal(size=(60, 3))
    cheap, unaffordable = (
        linearized(linear.problem(effects), np.zeros(4), (Given(h),), n) for n in (1, 5)
    )
    key = Hypothesis(frozenset({0, 1}), 0)
    np.testing.assert_allclose(cheap.weigh(key).nats - unaffordable.weigh(key).nats, 3 * np.log(5))


@pytest.mark.parametrize("members", [(), (0,), (0, 1)])
def test_sets_without_an_unknown_pay_for_every_effect(members):
    effects = (linear.line("push"), linear.line("pull"))
    cheap, unaffordable = (linearized(linear.problem(effects), np.zeros(4), (), n) for n in (1, 5))
    key = Hypothesis(frozenset(members))
    paid = cheap.weigh(key).nats - unaffordable.weigh(key).nats
    np.testing.assert_allclose(paid, len(members) * np.log(5), rtol=1e-9, atol=1e-9)


def test_drift_moves_its_channel_only_and_alike_in_repeats():
    from dataclasses import replace

    runs = [linear.run("r1", 1), replace(linear.run("r2", 2), group="r1"), linear.run("r3", 3)]
    problem = linear.problem((), runs)
    h = (
        UnknownDrift(1, "drift")
        .responses(problem, np.zeros(2))
        .reshape(3, linear.NUM_SAMPLES, 2, -1)
    )
    assert not h[:, :, 0].any()
    np.testing.assert_array_equal(h[0], h[1])
    assert not (h[0].any(axis=(0, 1)) & h[2].any(axis=(0, 1))).any()
    assert h[2].any()


def stopped_at(best, x):
    """A fit that ended at x, and what its linearization says."""
    residual = best.problem.residual(x)
    fit = replace(best, x=x, residual=residual, chi2=residual @ residual, prior=x @ x)
    own = LaplaceEvidence(best.problem, x, residual, best.jacobian, [], 1)
    return fit, own.weigh(Hypothesis())


@pytest.mark.reference
def test_what_a_fit_left_unrealized_is_what_its_cost_lies_above_the_optimum():
    runs = (linear.run("r1", 1), linear.run("r2", 2))
    best = fit(linear.model(), runs, linear.CHANNELS)
    assert unrealized(*stopped_at(best, best.x)) == pytest.approx(0.0, abs=1e-6)

    def cost(x):
        return 0.5 * float(np.sum(best.problem.residual(x) ** 2) + x @ x)

    x = best.x + np.array([0.4, -0.3])
    assert unrealized(*stopped_at(best, x)) == pytest.approx(cost(x) - cost(best.x), rel=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("at", [1.0, 0.6])
def test_a_fit_on_its_bound_is_credited_with_what_lies_within(at):
    """At the bound nothing is left; before it, what leads to it."""
    runs = moved(mass=4.0)
    best = fit(
        bounded(linear.problem((), runs), [-np.inf] * 2, [1.0, np.inf]).model, runs, linear.CHANNELS
    )
    assert best.at_bound == ("mass",)
    x = best.x.copy()
    x[0] = at
    ended, posterior = stopped_at(best, x)
    assert unrealized(ended, posterior) == pytest.approx(
        0.5 * (ended.chi2 + ended.prior - best.chi2 - best.prior), rel=1e-6, abs=1e-6
    )


def null_at(fit, at):
    """A plain model that is fitted, one candidate, no unknown cause."""
    runs = fit.problem.runs
    study = Study("linear", "soft_body", linear.CHANNELS, runs)
    case = Case(study, fit.problem.model, (linear.line("push"),), (), DiagnosisSettings())
    noise = noise_floor(runs, study.channels, {run.name: run.measured for run in runs})
    return Null(case, noise, fit, at, 0)


def test_the_search_does_not_credit_an_optimum_that_a_fit_has_not_reached():
    problem = linear.problem(())
    found = fit(problem.model, problem.runs, linear.CHANNELS)
    moved = found.x + np.array([0.4, -0.3])
    nats = []
    for x in (found.x, moved):
        stopped, posterior = stopped_at(found, x)
        null = null_at(stopped, linearization_at(found.problem, x))
        nats.append(begin(null, Simulations(null.wide)).nats(Hypothesis()))
    assert nats[0] - nats[1] == pytest.approx(unrealized(stopped, posterior), rel=1e-6)


def test_twins_of_base_parameters_and_of_each_other_are_weighed():
    """Their columns differ by rounding only; large sizes have hardly a prior."""
    twins = (linear.line("mass"), linear.line("mass", typical=0.4), linear.line("push"))
    runs = pushed(300.0)
    runs = [
        replace(r, measured=1e5 * (r.measured + 50.0 * linear.shapes("mass", r).numpy()[..., 0]))
        for r in runs
    ]
    lin = linearized(linear.problem(twins, runs), np.zeros(5), (), 1)
    for members in ({0}, {0, 1}, {0, 1, 2}):
        assert np.isfinite(lin.weigh(Hypothesis(frozenset(members))).nats)


@pytest.mark.parametrize("beside", [False, True])
def test_linear_evidence_reaches_to_thirty_typical_sizes(beside):
    """What lies beyond was not simulated: no credit for it, from a center where the size is 0."""
    effect, runs = linear.line("push"), pushed(400.0)  # a thousand typical sizes
    problem, key = (
        linear.problem((effect,), runs),
        Hypothesis(frozenset({0}), 0 if beside else None),
    )
    unknown = (UnknownDrift(0, "drift"),) if beside else ()
    posterior = linearized(problem, np.zeros(3), unknown, 1).weigh(key)
    size = 0.6 * problem.scaled(posterior.x)[2]
    assert size == pytest.approx(30.0 * effect.typical)
    if not beside:
        assert posterior.chi2 == pytest.approx(np.sum(problem.residual(posterior.x) ** 2), rel=1e-9)
        assert posterior.nats < -0.5 * posterior.chi2
    further = linearized(problem, posterior.x, unknown, 1).weigh(key)
    assert 0.6 * problem.scaled(further.x)[2] == pytest.approx(120.0 * effect.typical)


def test_knots_of_two_commands_are_turned_apart_and_weigh_as_one_block(monkeypatch):
    """Those of one command act in its runs only; a trace of all in every run makes one block."""
    problem = linear.problem((linear.line("push"),), (linear.run("r1", 1), linear.run("r2", 2)))
    x, sizes, eigh = np.zeros(len(problem.names)), [], linalg.eigh

    def counted(gram):
        sizes.append(len(gram))
        return eigh(gram)

    monkeypatch.setattr(linalg, "eigh", counted)
    apart = UnknownDrift(0, "drift").responses(problem, x)
    sizes.clear()
    found = []
    for responses in (apart, apart + 1e-12 * np.abs(apart).max()):
        evidence = LaplaceEvidence(problem, x, *problem.linearize(x), [responses], 1)
        found.append(evidence.weigh(Hypothesis(frozenset({0}), 0)))
    assert sizes == [apart.shape[1] // 2, apart.shape[1] // 2, apart.shape[1]]
    assert found[0].nats == pytest.approx(found[1].nats, abs=1e-6)
    np.testing.assert_allclose(found[0].x, found[1].x, atol=1e-6)
