"""Where laws may enter a described system, against its equations; laws as causes of a study."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Column
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem, extended_model, save_extended
from diffsim.identify.law import Entry, HiddenState, Law, Shape, Variable
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import load_extended, setup_of
from tests.diagnose.discover.turntable import DAMPING, NOISE, described, turntable_study

WARM = Variable("temp", "temp", "K", columns=("temp",))
FALLS = Law(
    "law_1",
    Entry("number", "c", "-", 1.0),
    WARM,
    "exponential",
    "size*(exp(rate*(u - 298.0)) - 1)",
    0.3,
    "-",
    {"rate": Shape(-0.02, 0.01, "1/K", upper=0.0)},
    price=3.5,
)


def thinner_when_warm(angle, speed, temp):
    return -DAMPING * speed * (np.exp(-0.024 * (temp - 298.0)) - 1.0)


@pytest.fixture(scope="module")
def table():
    """Recordings of a table whose oil gets thinner when it warms."""
    return turntable_study(thinner_when_warm, uses=("fit", "fit"), count=120)


@pytest.fixture(scope="module")
def setup(table):
    return setup_of(table)


def problem_of(setup, study, names=()):
    effects = tuple(e for e in setup.effects if e.name in names)
    return Problem(setup.model, study.fit_runs, WhiteNoise(study.channels), effects)


def with_law(setup, law=FALLS):
    """The system with a law among its causes."""
    return setup.laws.setup_with([setup.laws.block(law)])


# where one may enter


@pytest.mark.reference
def test_gains_are_those_of_the_equations(setup, table):
    """speed' = (torque - c speed)/J, by hand for a unit at each entry."""
    problem, port = problem_of(setup, table), setup.laws
    problem = replace(problem, runs=problem.runs[:1])
    x = np.array([0.4, -0.7, *np.zeros(problem.num_base - 2)])
    names = [p.name for p in setup.model.base]
    at = torch.from_numpy(x)
    values = {p.name: float(p.value_at(at[k])) for k, p in enumerate(setup.model.base)}
    assert names[:2] == ["J", "c"] and values["J"] != 0.01
    inertia, torque = values["J"], problem.runs[0].command["torque"]
    (path,) = port.courses(problem, x, [Variable("speed", "speed"), Variable("angle", "angle")])
    drag = values["c"] * path[:, 0]
    expected = {
        ("force", "shaft"): np.full(len(torque), 1.0 / inertia),
        ("rate", "speed"): np.ones(len(torque)),
        ("input", "torque"): np.full(len(torque), 1.0 / inertia),
        ("number", "c"): -drag / inertia,
        ("number", "J"): -(torque - drag) / inertia,
        ("reading", "angle_rad"): np.zeros(len(torque)),
    }
    for (kind, target), rate in expected.items():
        found = port.gains(problem, x, Entry(kind, target, "-", 1.0, 0))
        assert found.rates.shape == (len(torque), 1)  # of the speed: the angle's is a definition
        np.testing.assert_allclose(found.rates[:, 0], rate, rtol=1e-9, err_msg=target)
        at_once = np.ones(len(torque)) if kind == "reading" else np.zeros(len(torque))
        np.testing.assert_array_equal(found.readings[:, 0], at_once)


def test_entries_are_all_that_a_term_may_be_added_to(setup):
    found = {(e.kind, e.target): e.unit for e in setup.laws.entries}
    assert found == {
        ("force", "shaft"): "N m",
        ("number", "J"): "-",
        ("number", "c"): "-",
        ("input", "torque"): "-",
        ("reading", "angle_rad"): "rad",
    }
    assert all(e.scale > 0.0 for e in setup.laws.entries)


def test_a_law_is_added_to_a_number_that_may_be_zero(table):
    """A share of nothing would be nothing: a pull of 0 +- 0.1 N m gets a term of its own unit."""
    pull = {"value": 0.0, "sd": 0.1, "unit": "N m"}
    model = described(rates={"angle": "speed", "speed": "(torque - drag + pull)/J"})
    model["parameters"] = {**model["parameters"], "pull": pull}
    study = replace(table, model=model)
    setup = setup_of(study)
    (entry,) = [e for e in setup.laws.entries if e.target == "pull"]
    assert (entry.kind, entry.unit, entry.scale) == ("value", "N m", 0.1)
    law = replace(FALLS, name="pulls", entry=entry, form="line", term="size*u", shapes={})
    extended = with_law(setup, law)
    problem = problem_of(extended, study, ("pulls",))
    size, x = 3e-4, np.zeros(problem.num_base + 1)
    x[-1] = problem.standardized(np.array([*x[:-1], size / problem.size_units[-1]]))[-1]
    run, plain = study.fit_runs[0], problem_of(setup, study)
    shown = problem.predict(run, torch.from_numpy(x))
    alone = plain.predict(
        pushed_by_temp(run, size), torch.zeros(plain.num_base, dtype=torch.float64)
    )
    assert float((shown - alone).abs().max()) < 0.02 * float(
        (shown - plain.predict(run, torch.zeros(plain.num_base, dtype=torch.float64))).abs().max()
    )


def pushed_by_temp(run, size):
    """The run with what a law of the temperature pulls added to its torque."""
    return replace(run, command={"torque": run.command["torque"] + size * run.columns["temp"]})


def test_variables_have_recorded_columns_and_memories_among_them(setup):
    found = setup.laws.variables()
    plain = {v.name: v.unit for v in found if not v.memory}
    assert plain == {
        "angle": "rad",
        "speed": "rad/s",
        "torque": "-",
        "drag": "-",
        "temp": "K",
        "time": "s",
    }
    assert {v.memory for v in found} == {"", "heat", "relaxation", "slip", "work", "oscillator"}


def test_an_output_of_the_experiment_is_no_variable(table):
    """Another marker of the same arm follows what is left of the first one by itself."""

    def seen_twice(run):
        noise = np.random.default_rng(7).normal(size=len(run.time_s))
        marker = 0.5 + 2.0 * run.measured[:, 0] + 3.0 * NOISE * noise
        return replace(run, columns={**run.columns, "marker": marker})

    runs = tuple(seen_twice(run) for run in table.runs)
    columns = (*table.columns, Column("marker", table.channels[0].unit, "marker"))
    names = {v.name for v in setup_of(replace(table, runs=runs, columns=columns)).laws.variables()}
    assert "temp" in names and "marker" not in names


@pytest.mark.reference
def test_memories_are_what_their_names_say(setup, table):
    """A slow share, a heat and a way gone along the run, against sums over its samples."""
    problem, port = problem_of(setup, table), setup.laws
    problem = replace(problem, runs=problem.runs[:1])
    run, lasting = problem.runs[0], 0.8
    numbers = {"lasting": lasting}
    heat = {"hidden": HiddenState("(torque**2 - hidden)/lasting")}
    asked = [
        Variable("heat", "hidden", states=heat, memory="heat", numbers=numbers),
        Variable("way", "hidden", states={"hidden": HiddenState("abs(speed)")}, memory="work"),
        Variable("behind", "angle - hidden", states={"hidden": HiddenState("speed", "angle")}),
    ]
    (found,) = port.courses(problem, np.zeros(problem.num_base), asked)
    (speed,) = port.courses(problem, np.zeros(problem.num_base), [Variable("speed", "speed")])
    step = np.diff(run.time_s)
    kept, heats = np.exp(-step / lasting), [0.0]
    for share, u in zip(kept, run.command["torque"][:-1], strict=True):  # held from row to row
        heats.append(share * heats[-1] + (1.0 - share) * u**2)
    np.testing.assert_allclose(found[:, 0], heats, rtol=1e-5, atol=1e-9)
    way = np.concatenate([[0.0], np.cumsum(0.5 * step * np.abs(speed[1:] + speed[:-1])[:, 0])])
    np.testing.assert_allclose(found[:, 1], way, atol=5e-3 * way[-1])
    np.testing.assert_allclose(found[:, 2], 0.0, atol=1e-12)


@pytest.mark.reference
def test_work_rubbing_and_rest_are_those_of_the_way_gone(setup, table):
    """Memories that a place has of its speed, against sums over a run's samples."""
    problem, port = problem_of(setup, table), setup.laws
    problem = replace(problem, runs=problem.runs[:1])
    every = {v.name: v for v in port.variables() if v.numbers.get("lasting", 0.0) < 1.0}
    names = ("work done at shaft", "heat of |speed|", "rest at shaft")
    work, rubbed, rest = (every[name] for name in names)
    assert (work.memory, work.of) == ("work", "angle")
    assert (rubbed.memory, rubbed.of) == ("heat", "speed")
    assert (rest.memory, rest.of) == ("relaxation", "speed")
    plain = [Variable("angle", "angle"), Variable("speed", "speed")]
    (found,) = port.courses(problem, np.zeros(problem.num_base), [*plain, work, rubbed, rest])
    angle, speed = found[:, 0], found[:, 1]
    step = np.diff(problem.runs[0].time_s)
    power = np.abs(angle * speed)
    done = np.concatenate([[0.0], np.cumsum(0.5 * step * (power[1:] + power[:-1]))])
    np.testing.assert_allclose(found[:, 2], done, atol=1e-2 * done[-1])
    slow = rest.numbers["slow_speed"]
    for column, drive, memory in (
        (3, np.abs(speed), rubbed),
        (4, np.exp(-((speed / slow) ** 2)), rest),
    ):
        kept, out = np.exp(-step / memory.numbers["lasting"]), [0.0]
        for share, now in zip(kept, 0.5 * (drive[1:] + drive[:-1]), strict=True):
            out.append(share * out[-1] + (1.0 - share) * now)
        np.testing.assert_allclose(found[:, column], out, atol=2e-2 * max(out))


def test_a_number_may_depend_on_what_is_made_of_it(setup, table):
    """The drag is made of c: a law of c over the drag means the drag as it was before."""
    port = setup.laws
    entry, drag = Entry("number", "c", "-", 1.0), Variable("drag", "drag")
    effect = port.terms(entry, drag, ["u"], "law", 1.0)
    problem = problem_of(setup, table)
    problem = replace(problem, effects=(effect,), runs=problem.runs[:1])
    size = 0.5
    x = np.zeros(len(problem.names))
    x[-1] = np.arcsinh(1.5 * size / 1.5) / 1.5
    found = problem.predict(problem.runs[0], torch.from_numpy(x))[:, 0].numpy()
    # c speed (1 + size c speed): square drag, by other words
    model = described(
        define={"drag": "c*speed*(1 + 0.5*c*speed)"}, effects={"only": ["command_gain"]}
    )
    plain = setup_of(replace(table, model=model)).model
    expected = plain.predict(problem.runs[0], plain.at_prior())[:, 0].numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


# laws as causes


def test_a_laws_numbers_are_known_as_its_shapes_say(setup):
    made = with_law(setup)
    effect = next(e for e in made.effects if e.name == "law_1")
    rate = next(p for p in made.model.base if p.name == "rate_of_law_1")
    assert (effect.typical, effect.unit, effect.price, effect.signed) == (0.3, "-", 3.5, True)
    assert effect.scanned and effect.tries == (-1.0, 1.0)
    assert (rate.value, rate.sd, rate.unit, rate.upper) == (-0.02, 0.01, "1/K", 0.0)


def test_a_laws_numbers_do_nothing_where_it_is_off(setup, table):
    problem = problem_of(with_law(setup), table, ["law_1"])
    k = problem.names.index("rate_of_law_1")
    x = np.zeros(len(problem.names))
    slopes = linearization_at(problem, x).columns
    np.testing.assert_array_equal(slopes[:, k], 0.0)
    x[-1] = 0.5
    assert np.abs(linearization_at(problem, x).columns[:, k]).max() > NOISE


@pytest.mark.reference
def test_a_law_of_a_column_finds_its_numbers(setup, table):
    """The constant of c exp(-0.024 (temp - 298)) is c's own."""
    problem = problem_of(with_law(setup), table, ["law_1"])
    fit, _ = gauss_newton(problem, linearization_at(problem, 0.3 * np.eye(len(problem.names))[-1]))
    for name, truth in {"rate_of_law_1": -0.024, "law_1": 1.0, "c": DAMPING}.items():
        assert abs(fit.values[name] - truth) < 4.0 * fit.sd[name] + 1e-3 * abs(truth)
    assert fit.sd["rate_of_law_1"] < 0.5 * FALLS.shapes["rate"].sd
    assert fit.chi2 < 1.3 * sum(len(r.time_s) for r in table.fit_runs)


def test_a_saved_law_means_the_same_on_another_study(setup, table, tmp_path):
    made = with_law(setup)
    problem = problem_of(made, table, ["law_1"])
    fit, _ = gauss_newton(problem, linearization_at(problem, 0.3 * np.eye(len(problem.names))[-1]))
    save_extended(fit, tmp_path / "extended_model.yaml", study=table, verdict="described")
    other = turntable_study(uses=("test", "test"), seed=9, count=90)
    again, before = load_extended(tmp_path, other), extended_model(fit)
    assert [e.name for e in again.effects] == ["law_1"]
    for run in other.runs:
        found, expected = (m.predict(run, m.at_prior()).numpy() for m in (again, before))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        plain = setup.model.predict(run, setup.model.at_prior()).numpy()
        assert np.abs(found - plain).max() > 0.1


def test_a_saved_law_needs_its_column(setup, table, tmp_path):
    problem = problem_of(with_law(setup), table, ["law_1"])
    fit, _ = gauss_newton(problem, linearization_at(problem, 0.3 * np.eye(len(problem.names))[-1]))
    save_extended(fit, tmp_path / "extended_model.yaml", study=table, verdict="described")
    runs = tuple(replace(run, columns={}) for run in table.runs)
    with pytest.raises(ValueError, match=r"effects\.own\[0\]\.term: .*'temp' is not known here"):
        load_extended(tmp_path, replace(table, runs=runs, columns=()))


def own(**changes):
    block = {"name": "warming", "multiplies": "c", "term": "1 + size*(temp - 298)"}
    return described(effects={"own": [{**block, "typical": 0.02, "unit": "1/K", **changes}]})


def test_a_cause_of_ones_own_may_use_a_column(table):
    made = setup_of(replace(table, model=own()))
    problem = problem_of(made, table, ["warming"])
    fit, _ = gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))
    line = np.polyfit([-16.0, 0.0, 16.0], np.exp(-0.024 * np.array([-16.0, 0.0, 16.0])), 1)
    assert fit.values["warming"] == pytest.approx(line[0] / line[1], rel=0.2)


def test_a_column_that_is_not_there_is_told(table):
    model = own(term="1 + size*(temperature - 298)")
    with pytest.raises(ValueError, match=r"effects\.own\[0\]\.term: .*'temperature' is not known"):
        setup_of(replace(table, model=model))
