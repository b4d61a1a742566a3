"""Simulations that lie on recordings, and what laws would do there, against the simulator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from diffsim.diagnose.discover import follow as following
from diffsim.diagnose.discover.follow import Reach, follow
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.law import Entry, Variable
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of
from tests.diagnose.discover.turntable import NOISE, described, turntable_study

TERMS = ("sin(2*u + 0.4)", "u**2/20")
#: the entry, and a factor that is small there
ENTRIES = [
    (Entry("force", "shaft", "N m", 0.1), 1e-5),
    (Entry("rate", "lag", "1/s", 1.0), 1e-5),
    (Entry("number", "c", "-", 1.0), 1e-4),
    (Entry("number", "J", "-", 1.0), 1e-4),
    (Entry("input", "torque", "N m", 0.1), 1e-5),
    (Entry("reading", "angle_rad", "rad", 1.0, 0), 1e-4),
]


def cogging(angle, speed, temp):
    return 0.02 * np.sin(7.0 * angle + 0.6)


@pytest.fixture(scope="module")
def fitted():
    """The plain model's fit to a table with a cogging motor, and what its system offers."""
    model = described(effects={"only": ["command_gain"]})
    model["inputs"] = [{"name": "torque", "held": False}]  # what jumps, courses round off
    model["states"]["lag"] = "0"  # a motor that follows its command
    model["rates"] |= {"lag": "(torque - lag)/0.05", "speed": "(lag - drag)/J"}
    study = turntable_study(cogging, uses=("fit", "fit"), noise=0.01, count=160, model=model)
    setup = setup_of(study)
    problem = Problem(setup.model, study.fit_runs, WhiteNoise(study.channels))
    start = linearization_at(problem, np.zeros(problem.num_base))
    return gauss_newton(problem, start)[0], setup.laws


@pytest.fixture(scope="module")
def followed(fitted):
    return follow(*fitted)


def test_it_lies_on_the_record(fitted, followed):
    """As far as noise: without a course the table is a turn off."""
    count = len(followed.missing)
    assert followed.chi2 < 1.1 * count < 0.01 * fitted[0].chi2
    problem, x = followed.problems[0], followed.points[0]
    off = problem.runs[0].measured.ravel() - problem.record(x)
    assert np.sqrt(np.mean(off**2)) < 1.1 * 10.0 * NOISE


@pytest.mark.grad
@pytest.mark.parametrize(("entry", "step"), ENTRIES, ids=lambda e: getattr(e, "words", None))
def test_columns_are_what_the_simulator_does(fitted, followed, entry, step):
    """Two terms of the angle at each entry, against small factors of them in the simulation."""
    variable, port = Variable("angle", "angle", "rad"), fitted[1]
    terms = [
        np.stack([np.sin(2.0 * a[:, 0] + 0.4), a[:, 0] ** 2 / 20.0], 1)
        for a in followed.courses(port, [variable])
    ]
    found = followed.reach(port, entry).columns(terms)
    effect = port.terms(entry, variable, TERMS, "law", 1.0)
    for k in range(len(TERMS)):
        rows = []
        for problem, x in zip(followed.problems, followed.points, strict=True):
            more = replace(problem, effects=(*problem.effects, effect))
            sizes = np.zeros((2, len(more.names)))
            sizes[:, : len(x)] = problem.scaled(x)
            sizes[:, len(x) + k] = np.array([1.0, -1.0]) * step / PRIOR_WIDTH
            up, down = (more.whiten_all(more.record(more.standardized(s))) for s in sizes)
            rows.append((up - down) / (2.0 * step))
        expected = np.concatenate(rows)
        off = np.linalg.norm(found[:, k] - expected) / np.linalg.norm(expected)
        assert off < 1e-2, f"{entry.words}: {off:.2g}"


def test_a_course_is_a_detour(fitted, followed):
    """What is missing is what is left with it, and what it does by its responses."""
    problem, x = followed.problems[0], followed.points[0]
    u = problem.scaled(x)
    done = 0.0
    for course in (e for e in problem.effects if e.family == "course"):
        own = problem.columns_of(course)
        knots = [i - len(fitted[0].x) for i in own]
        done = done + followed.responses[0][:, knots] @ (PRIOR_WIDTH * course.typical * u[own])
    left = problem.whiten_all(problem.runs[0].measured.ravel() - problem.record(x))
    assert np.linalg.norm(done) > 10.0 * np.linalg.norm(left)
    np.testing.assert_allclose(followed.missing[: len(left)], left + done, rtol=1e-9, atol=1e-9)


def test_nothing_is_led_where_nothing_can_push():
    """Static readings: the model itself stands on the record, slopes and all."""
    study = turntable_study(uses=("fit", "fit"), count=40, model=BENCH)
    setup = setup_of(study)
    problem = Problem(setup.model, study.fit_runs, WhiteNoise(study.channels))
    fit, _ = gauss_newton(problem, linearization_at(problem, np.zeros(problem.num_base)))
    seen = follow(fit, setup.laws)
    np.testing.assert_allclose(seen.chi2, fit.chi2, rtol=1e-9)
    entry = next(e for e in setup.laws.entries if e.kind == "number")
    u = seen.courses(setup.laws, [Variable("torque", "torque")])
    found = seen.reach(setup.laws, entry).columns(u)
    # angle = k torque (1 + size torque)
    k = fit.values["k"]
    expected = np.concatenate([k * v**2 / NOISE for v in u])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


BENCH = {
    "system": "bench",
    "readings": {"angle_rad": "k*torque"},
    "parameters": {"k": {"value": 3.0, "percent": 30}},
}


def test_readings_of_windows_are_known_by_their_samples(monkeypatch):
    """What flights read was known by all readings that a start state moves, 13 for each sample."""
    rng = np.random.default_rng(0)
    windows = [rng.normal(size=(26, 6)) for _ in range(3)]
    windows[1][:, 2] = 0.0  # a sample that is missing
    read = sparse.csr_array(sparse.block_diag(windows))
    quick = Reach((following._read_at_once(read),))
    monkeypatch.setattr(following, "MOST_KNOTS", 5)
    plain = Reach((following._read_at_once(read),))
    terms, rows = [rng.normal(size=(18, 4))], rng.normal(size=(78, 3))
    made, wanted = quick.coordinates(terms), plain.coordinates(terms)
    assert len(made) == 17 and len(wanted) == 78  # what is missing moves nothing
    np.testing.assert_allclose(made.T @ made, wanted.T @ wanted, rtol=0.0, atol=1e-10)
    for seen in (rows, rows[:, 0]):
        products = quick.seen(seen).T @ made, plain.seen(seen).T @ wanted
        np.testing.assert_allclose(*products, rtol=0.0, atol=1e-10)
    columns = quick.columns(terms), plain.columns(terms)
    np.testing.assert_allclose(*columns, rtol=0.0, atol=1e-12)
