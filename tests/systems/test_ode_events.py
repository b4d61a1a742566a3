"""What acts for a limited time: forms, where they lie, and that a model keeps its meaning."""

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.identify.locate import Course
from diffsim.systems.ode.event_effects import timings
from diffsim.systems.ode.event_forms import TIMINGS, placed, shape_of
from diffsim.systems.ode.keys import Events

TRUE = {"onset": 3.02, "width": 1.5, "period": 4.0}


@pytest.mark.parametrize("form", TIMINGS)
def test_a_form_is_found_where_it_lies(form):
    """From a noisy course, knots 0.1 s apart: size within 5 %, times within half a knot."""
    times = np.arange(0.0, 20.0, 0.1)
    timing = {k: torch.tensor(TRUE[k]) for k in TIMINGS[form]}
    if form == "burst":
        timing |= {"width": torch.tensor(6.0), "period": torch.tensor(1.5)}
    shape = shape_of(form, torch.from_numpy(times), timing, 0.1).numpy()
    rng = np.random.default_rng(1)
    noise = 0.05  # the onset of a ramp is known to 0.01 s then
    force = 3.0 * shape + noise * rng.normal(size=len(times))
    course = Course(times, np.eye(len(times)) / noise**2, force / noise**2)

    size, found = placed(form, course, 1.0)[0]

    assert size == pytest.approx(3.0, rel=0.05)
    for name, value in timing.items():
        assert found[name] == pytest.approx(float(value), abs=0.06), name


def test_a_clock_that_begins_elsewhere_moves_where_events_are_looked_for_and_nothing_else():
    def asked(begin):
        clock = begin + 0.125 * np.arange(101)  # exact: no knot more by rounding
        run = Run("a", clock, np.zeros((101, 1)), {}, "a")
        study = Study("s", "ode", (Channel("q", "m", "position"),), (run,))
        return timings(Events(at=("q",)), study)

    plain, late = asked(0.0), asked(64.0)
    assert set(plain) == {"event_onset", "event_width", "event_period"}
    for name, stated in plain.items():
        moved = stated.value + (64.0 if name == "event_onset" else 0.0)
        assert late[name].value == pytest.approx(moved), name
        for what in ("sd", "lower", "step"):
            assert getattr(late[name], what) == pytest.approx(getattr(stated, what)), (name, what)


def test_the_right_form_gains_most():
    times = np.arange(0.0, 20.0, 0.1)
    timing = {k: torch.tensor(TRUE[k]) for k in TIMINGS["train"]}
    force = 3.0 * shape_of("train", torch.from_numpy(times), timing, 0.1).numpy()
    course = Course(times, np.eye(len(times)), force)

    def gain(form):
        _, at = placed(form, course, 1.0)[0]
        places = {k: torch.tensor(v) for k, v in at.items()}
        shape = shape_of(form, torch.from_numpy(times), places, 0.1).numpy()
        return course.gains(shape[:, None])[0]

    gains = {form: gain(form) for form in TIMINGS}
    assert max(gains, key=gains.get) == "train"
    assert gains["train"] > 1.5 * gains["pulse"]


def test_a_shape_that_nothing_shows_gains_nothing():
    """Before the record begins a form only divides rounding by rounding."""
    times = np.arange(0.0, 5.0, 0.1)
    course = Course(times, np.eye(len(times)), np.ones(len(times)))
    before = np.full((len(times), 1), 1e-9)
    assert course.sizes(before)[0] == 0.0


def _cart(folder, *, seed):
    """A cart with friction; in one of two runs 2 N push from 3.0 to 4.5 s."""
    from scipy.integrate import solve_ivp

    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 8.0, 0.02)
    for name in ("calm", "push"):
        u = 3.0 * np.sin(1.3 * t)

        def rates(s, y, name=name, u=u):
            drive = u[min(int(s / 0.02 + 1e-9), len(t) - 1)]
            extra = 2.0 if name == "push" and 3.0 <= s < 4.5 else 0.0
            return y[1], (drive + extra - 1.5 * y[1] - 20.0 * y[0]) / 2.0

        x = solve_ivp(rates, (0, 8), (0.0, 0.0), t_eval=t, max_step=0.005, rtol=1e-8).y[0]
        table = np.column_stack([t, x + 1e-3 * rng.normal(size=len(t)), u])
        np.savetxt(
            folder / f"{name}.csv",
            table,
            delimiter=",",
            header="time_s,x,u",
            comments="",
            fmt="%.6f",
        )


STUDY = """
name: cart
model:
  system: ode
  states: {{x: 0, v: 0}}
  inputs: [{{name: u, held: true}}]
  parameters: {{mass: {{value: 2 kg, percent: 5}}, damping: {{value: 1.5, percent: 30}}}}
  rates: {{x: v, v: "(u - damping*v - 20*x)/mass"}}
  readings: {{x_seen: x}}
  places: [{{name: cart, position: x, velocity: v, inertia: mass, stick_velocity: 0.01}}]
  events: [{{at: [cart, u, x_seen], forms: [step, pulse], where: {{who: stranger}}, knots: 100}}]
  effects: {{only: [viscous_friction, constant_force, {events}]}}
channels: [{{name: x_seen, column: x, unit: m, sd: 0.001}}]
commands: [{{name: u, unit: N}}]
runs:
{runs}
"""
EVENTS = "step_event_at_cart, pulse_event_at_cart, step_event_at_x_seen, pulse_event_at_x_seen"
RUNS = """  - {name: calm, file: calm.csv, setup: {who: nobody}}
  - {name: push, file: push.csv, setup: {who: stranger}}"""


def test_a_push_is_said_in_words(tmp_path):
    """When, how large, of what form, where; a voltage that does the same is said with it."""
    from diffsim.data import load_study
    from diffsim.diagnose import diagnose
    from diffsim.systems import setup_of

    _cart(tmp_path, seed=0)
    (tmp_path / "study.yaml").write_text(STUDY.format(events=EVENTS, runs=RUNS))
    study = load_study(tmp_path)
    made = setup_of(study)
    report = diagnose(study, made.model, made.effects, seed=0, settings=made.settings)

    assert report.verdict == "named"
    # it acted once: no other recording confirms it
    found = {row.name: row for row in report.causes if row.status == "likely"}
    assert list(found) == ["pulse_event_at_cart"]
    assert found["pulse_event_at_cart"].doubts == (
        "the gain may be chance on parts that were left out",
    )
    words = found["pulse_event_at_cart"].words
    assert words.startswith("a pulse of ") and " N at cart or " in words and " at u from " in words
    size = found["pulse_event_at_cart"].size["size"]
    assert size.low < 2.0 < size.high
    values = {row.name: row.value for row in report.base}
    assert values["event_onset"] == pytest.approx(3.0, abs=0.02)
    assert values["event_width"] == pytest.approx(1.5, abs=0.02)


def test_forms_at_one_place_do_not_stand_for_each_other(tmp_path):
    """A form of size 0 beside another leaves it as it is."""
    from diffsim.data import load_study
    from diffsim.systems import setup_of

    _cart(tmp_path, seed=0)
    (tmp_path / "study.yaml").write_text(STUDY.format(events=EVENTS, runs=RUNS))
    study = load_study(tmp_path)
    made = setup_of(study)
    step, pulse = (
        next(e for e in made.effects if e.name == f"{form}_event_at_cart")
        for form in ("step", "pulse")
    )
    run, q = study.runs[1], made.model.at_prior()
    size, none = torch.tensor([2.0]).double(), torch.tensor([0.0]).double()
    alone = made.model.predict(run, q, {pulse: size})
    torch.testing.assert_close(made.model.predict(run, q, {pulse: size, step: none}), alone)
    torch.testing.assert_close(made.model.predict(run, q, {step: none, pulse: size}), alone)
    assert (alone - made.model.predict(run, q, {})).abs().max() > 1e-3


TANK = """
name: tank
model:
  system: ode
  states: {level: {value: 2 m, sd: 0.2}}
  inputs: [{name: pump, held: true}]
  rates: {level: "0.1*pump - 0.05*level"}
  readings: {seen: level}
  ranges: {seen: [0, 2.5]}
channels: [{name: seen, unit: m, sd: 0.01}]
commands: [{name: pump, unit: "-"}]
runs: [{name: all, file: all.csv, blocks: {num: 4, run_up: true, use: {test: [4]}}}]
"""


def test_blocks_with_a_run_up_share_one_start_and_a_sensor_ends(tmp_path):
    """Each block is simulated from the record's first sample, and compared on its own ones."""
    from diffsim.data import load_study
    from diffsim.systems import setup_of

    t = np.arange(0.0, 40.0, 0.5)
    table = np.column_stack([t, np.full_like(t, 2.0), np.full_like(t, 3.0)])
    np.savetxt(
        tmp_path / "all.csv",
        table,
        delimiter=",",
        header="time_s,seen,pump",
        comments="",
        fmt="%.4f",
    )
    (tmp_path / "study.yaml").write_text(TANK)
    study = load_study(tmp_path)
    made = setup_of(study)
    assert {p.name for p in made.model.base if p.name.startswith("level")} == {"level_start"}
    last = study.test_runs[0]
    assert last.time_s[0] == 0.0 and len(last.time_s) == len(t)
    assert np.isfinite(last.measured[:, 0]).sum() == len(t) // 4
    level = 6.0 - 4.0 * np.exp(-0.05 * t)  # from 2 m towards 6 m
    shown = made.model.predict(last, made.model.at_prior(), {})[:, 0].numpy()
    np.testing.assert_allclose(shown, np.minimum(level, 2.5), atol=1e-6)
