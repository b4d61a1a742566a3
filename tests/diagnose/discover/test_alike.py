"""One law at several alike places: zones of an oven that radiate, together or one alone."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose.discover.follow import follow
from diffsim.diagnose.discover.screen import screen_laws
from diffsim.diagnose.search.fit import silent
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem
from diffsim.identify.law import Law
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of

ROOM, STEP, NOISE = 295.0, 20.0, 0.2  # [K], [s], [K]
HEAT, LOSS, ACROSS = np.array([1500.0, 2000.0]), np.array([2.0, 2.5]), 4.0  # [J/K], [W/K], [W/K]
RADIATES = 1.5e-9  # [W/K^4]
MODEL = {
    "system": "ode",
    "parameters": {
        "heat_a": {"value": 1500.0, "unit": "J/K", "percent": 5},
        "heat_b": {"value": 2000.0, "unit": "J/K", "percent": 5},
        "loss_a": {"value": 2.0, "unit": "W/K", "percent": 20},
        "loss_b": {"value": 2.5, "unit": "W/K", "percent": 20},
        "across": {"value": 4.0, "unit": "W/K", "percent": 20},
    },
    "inputs": [{"name": "power_a", "held": True}, {"name": "power_b", "held": True}],
    "states": {"a": ROOM, "b": ROOM},
    "rates": {
        "a": "(power_a - loss_a*(a - 295) - across*(a - b))/heat_a",
        "b": "(power_b - loss_b*(b - 295) + across*(a - b))/heat_b",
    },
    "readings": {"zone_a": "a", "zone_b": "b"},
    "effects": {"only": []},
}


def oven(radiates):
    """Two zones that are heated by steps.

    Args:
        radiates: Radiation of each zone [W/K^4], (2,).
    """
    rng = np.random.default_rng(0)
    runs = []
    for k in range(4):
        power = np.repeat(rng.uniform(100.0, 1200.0, (9, 2)), 10, axis=0)
        zones, seen = np.full(2, ROOM), []
        for heat in power:
            seen.append(zones)
            for _ in range(10):
                lost = LOSS * (zones - ROOM) + radiates * (zones**4 - ROOM**4)
                goes = ACROSS * (zones[0] - zones[1]) * np.array([1.0, -1.0])
                zones = zones + 0.1 * STEP * (heat - lost - goes) / HEAT
        measured = np.array(seen) + rng.normal(0.0, NOISE, (len(seen), 2))
        commands = {"power_a": power[:, 0], "power_b": power[:, 1]}
        runs.append(Run(f"run_{k}", STEP * np.arange(len(power)), measured, commands, f"run_{k}"))
    channels = tuple(Channel(f"zone_{z}", "K", "temperature", NOISE) for z in "ab")
    commands = tuple(Command(f"power_{z}", "W") for z in "ab")
    return Study("oven", "ode", channels, tuple(runs), commands=commands, model=MODEL)


def plain_fit(study, made):
    problem = Problem(made.model, study.fit_runs, WhiteNoise(study.channels))
    start = linearization_at(problem, np.zeros(problem.num_base))
    return gauss_newton(problem, start)[0]


def best_law(radiates, model=MODEL):
    study = replace(oven(np.array(radiates)), model=model)
    made = setup_of(study)
    screen = screen_laws(follow(plain_fit(study, made), made.laws), made.laws, silent)
    return next(law for law in screen.holding if law.entry.kind != "reading")


def test_a_law_of_all_zones_is_found_at_all_of_them():
    law = best_law([RADIATES, RADIATES])
    assert [part.target for part in law.entry.parts] == ["a", "b"] and law.entry.unit == "W"
    assert law.variable.name == "its own value" and law.gained > 0.9 * law.nats


def test_a_law_of_one_zone_is_found_there():
    law = best_law([0.0, RADIATES])
    # as heat that is lost, or as a conductance that grows
    assert law.entry.target in ("b", "loss_b") and law.variable.name == "b"


def test_what_flows_between_two_zones_is_told_by_their_difference():
    """A leak between two chambers was unknown: it enters one by what leaves the other."""
    rates = {z: f"(power_{z} - loss_{z}*({z} - 295))/heat_{z}" for z in "ab"}
    law = best_law([0.0, 0.0], {**MODEL, "rates": rates})
    assert [part.target for part in law.entry.parts] == ["a", "b"] and law.entry.unit == "W"
    assert law.variable.name == "its own value below the other's"
    assert [part.formula for part in law.variable.parts] == ["(b) - (a)", "(a) - (b)"]
    assert law.gained > 0.9 * law.nats


def test_a_product_of_two_states_is_found_at_both():
    """A reaction takes of two dissolved things alike, as fast as the product of both says; laws of
    two variables were asked for at single entries alone."""
    rng, step, runs = np.random.default_rng(1), 0.5, []
    for k in range(4):
        feed = np.repeat(rng.uniform(0.0, 3.0, (9, 2)), 8, axis=0)
        held, seen = np.zeros(2), []
        for flows_in in feed:
            seen.append(held)
            for _ in range(10):
                held = held + 0.1 * step * (0.3 * (flows_in - held) - 0.25 * held.prod())
        measured = np.array(seen) + rng.normal(0.0, 0.01, (len(seen), 2))
        commands = {"feed_a": feed[:, 0], "feed_b": feed[:, 1]}
        runs.append(Run(f"run_{k}", step * np.arange(len(feed)), measured, commands, f"run_{k}"))
    model = {
        "system": "ode",
        "parameters": {"rinse": {"value": 0.3, "percent": 5, "unit": "1/s"}},
        "inputs": [{"name": f"feed_{z}", "held": True} for z in "ab"],
        "states": {"a": 0.0, "b": 0.0},
        "rates": {z: f"rinse*(feed_{z} - {z})" for z in "ab"},
        "readings": {f"probe_{z}": z for z in "ab"},
        "effects": {"only": []},
    }
    channels = tuple(Channel(f"probe_{z}", "mol/m^3", "concentration", 0.01) for z in "ab")
    commands = tuple(Command(f"feed_{z}", "mol/m^3") for z in "ab")
    study = Study("tank", "ode", channels, tuple(runs), commands=commands, model=model)
    made = setup_of(study)
    screen = screen_laws(follow(plain_fit(study, made), made.laws), made.laws, silent)
    _, pairs, _ = screen.with_pairs(e for e in made.laws.entries if e.kind == "rate")
    best, alone = pairs[0], screen.holding[0]
    assert [part.target for part in best.entry.parts] == ["a", "b"]
    assert {best.variable.own_name, best.variable.times.name} == {"a", "b"}
    assert best.nats > alone.nats and best.gained > alone.gained


@pytest.mark.reference
def test_a_law_of_all_zones_is_saved_as_what_was_simulated():
    """The term without a form and the cause as it is written move the record alike."""
    study = oven(np.zeros(2))
    made = setup_of(study)
    port = made.laws
    entry = next(e for e in port.entries if e.parts and e.kind == "rate")
    variable = next(v for v in port.variables() if entry.words in v.at)
    law = Law("loses", entry, variable, "power", "size*(u**4 - 7.6e9)", 1e-9, entry.unit)
    effects = (
        port.terms(entry, variable, ["u**4 - 7.6e9"], "loses", 1e-9),
        next(e for e in port.setup_with([port.block(law)]).effects if e.name == "loses"),
    )
    records = []
    for effect in effects:
        problem = Problem(made.model, study.fit_runs, WhiteNoise(study.channels), (effect,))
        x = np.zeros(problem.num_base + 1)
        x[-1] = 1.0
        records.append(problem.record(x))
    plain = Problem(made.model, study.fit_runs, WhiteNoise(study.channels)).record(x[:-1])
    assert np.abs(records[0] - plain).max() > 1.0
    np.testing.assert_allclose(records[0], records[1], rtol=1e-12)
