"""Systems that a study describes by formulas: the plain model, its causes, and mistakes in it."""

import itertools
import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
import yaml
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from diffsim.data.signal import looks_held
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.identify import Numerics
from diffsim.systems.ode import mends, reading
from diffsim.systems.registry import description_of, load_extended, setup_of
from tests.diagnose.discover.answers import answer
from tests.systems.toy_cart import TIME, cart_study, described


@lru_cache
def plain_study():
    """The cart with nothing hidden, as good as without noise."""
    return cart_study(noise=1e-12)


@pytest.fixture(scope="module")
def plain():
    return setup_of(plain_study())


def effect(setup, name):
    return next(e for e in setup.effects if e.name == name)


def moved_exactly(u, m, c, k):
    """Position of a linear cart, (num_samples,) [m]: a force straight from sample to sample.

    The force and its slope belong to the state, so one matrix exponential is a sample interval.
    """
    h = TIME[1] - TIME[0]
    rates = np.zeros((4, 4))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = [-k / m, -c / m, 1.0 / m, 0.0]
    interval = expm(h * rates)
    moving = np.zeros((len(u), 2))
    for i, slope in enumerate(np.diff(u) / h):
        moving[i + 1] = (interval @ [*moving[i], u[i], slope])[:2]
    return moving[:, 0]


def left_out(w):
    """Share of what swings with w [rad/s] that Runge-Kutta's steps leave out over a recording.

    A step is the exponential's series to h^4: the next term is (w h)^5 / 120.
    """
    return len(TIME) * (w * (TIME[1] - TIME[0])) ** 5 / 120.0


@pytest.mark.reference
@pytest.mark.order
def test_plain_model_is_the_equation(plain):
    values = {"m": 1.01, "c": 0.85, "k": 41.0}
    q = torch.tensor(
        [p.coordinate_of(values.get(p.name, p.value)) for p in plain.model.base],
        dtype=torch.float64,
    )
    share = left_out(np.sqrt(values["k"] / values["m"]))
    for run in plain_study().runs:
        force = run.command["force"]
        exact = moved_exactly(force, **values)
        # at most the movement, and the point that it swings about
        swings = np.abs(exact).max() + np.abs(force).max() / values["k"]
        whole, half = (
            np.abs(plain.model.predict(run, q, numerics=n).numpy()[:, 0] - exact).max()
            for n in (Numerics(), Numerics(time_step=0.5))
        )
        assert whole < share * swings
        assert whole / half == pytest.approx(2.0**4, rel=0.02)


def test_finer_steps_change_little(plain):
    run, q = plain_study().fit_runs[2], plain.model.at_prior()
    fine = plain.model.predict(run, q, numerics=Numerics(time_step=0.25))
    assert 0.0 < (fine - plain.model.predict(run, q)).abs().max() < 1e-5


def test_samples_may_be_spaced_unevenly(plain):
    run = plain_study().fit_runs[2]
    kept = np.r_[0:40, 40:190:5, 190:210, 210:300:5]
    few = Run(
        "few", run.time_s[kept], run.measured[kept], {"force": run.command["force"][kept]}, "few"
    )
    q = plain.model.at_prior()
    full = plain.model.predict(run, q)[kept]
    assert (plain.model.predict(few, q) - full).abs().max() < 1e-4


STIFF = [
    *("stop_above", "stop_below", "added_spring", "quadratic_stiffness", "cubic_stiffness"),
    *("relaxing_spring", "dry_friction", "viscous_friction", "square_drag", "saturation"),
]
"""What a force that depends on the place could be taken for."""
HIDDEN = {
    "dry_friction": (0.6, {"force": lambda x, v: -0.6 * np.tanh(v / 0.01)}),
    "cubic_stiffness": (60.0, {"force": lambda x, v: -60.0 * x**3}),
    "delay": (0.03, {"drive": lambda u: np.interp(TIME - 0.03, TIME, u, left=0.0)}),
    "dead_band": (1.0, {"drive": lambda u: np.sign(u) * np.maximum(np.abs(u) - 1.0, 0.0)}),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.story] * (n != "dead_band")) for n in HIDDEN]
)
def test_a_hidden_cause_is_named_with_its_size(name):
    size, hidden = HIDDEN[name]
    report = answer(cart_study(**hidden))
    assert (report.verdict, report.named) == ("named", (name,))
    assert abs(report.best.values[name] - size) < 1.645 * report.best.sd[name] + 0.01 * size
    assert report.gain is not None and report.gain.low > 0.9


@pytest.mark.story  # two whole diagnoses
@pytest.mark.parametrize(
    ("name", "force"),
    [
        # thirty times as stiff as a usual force at a usual distance, and lossy
        ("stop_above", lambda x, v: -6000.0 * np.maximum(x - 0.25, 0.0) * (1.0 + np.tanh(v))),
        # a string of 0.3 m across the motion, unstretched at rest: between cubic and straight
        ("cubic_stiffness", lambda x, v: -60.0 * x * (1.0 - 0.3 / np.hypot(x, 0.3))),
    ],
)
def test_a_cause_of_another_shape_than_the_usual_is_named(name, force):
    model = described(effects={"only": STIFF})
    assert answer(cart_study(force=force, model=model)).named == (name,)


def held_cart(every=5, noise=1e-4, **changed):
    """A cart sampled every 50 ms whose amplifier holds a force that changes all the time."""
    rng = np.random.default_rng(0)
    runs = []
    for name, use, rate in (("slow", "fit", 2.0), ("mid", "fit", 5.0), ("fast", "test", 8.0)):
        t = TIME[::every]
        run = Run(name, t, np.zeros((len(t), 1)), {"force": 8.0 * np.sin(rate * t)}, name, use=use)
        runs.append(replace(run, setup={"load_kg": 0.0}))
    study = replace(
        plain_study(),
        runs=tuple(runs),
        model=described(inputs=["force"], time_step=0.005, **changed),
    )
    held = {"inputs": [{"name": "force", "held": True}], "effects": {}}
    true = replace(study, model={**study.model, **held})
    made = setup_of(true).model
    seen = [made.predict(r, made.at_prior()).numpy() for r in runs]
    noisy = [y + noise * rng.normal(size=y.shape) for y in seen]
    return replace(
        study, runs=tuple(replace(r, measured=y) for r, y in zip(runs, noisy, strict=True))
    )


def test_a_command_that_rests_and_jumps_is_held_and_check_says_so():
    rests = tuple(r for r in plain_study().runs if r.name in ("step", "large"))
    steps = replace(plain_study(), runs=rests, model=described(inputs=["force"]))
    (note,) = description_of(steps).problems(steps)
    assert note.severity == "note" and "rests and jumps" in note.message
    straight = replace(steps, model=described(inputs=[{"name": "force", "held": False}]))
    assert description_of(straight).problems(straight) == []
    run, other = steps.runs[0], setup_of(straight)
    made = setup_of(steps)
    moved = made.model.predict(run, made.model.at_prior()) - other.model.predict(
        run, other.model.at_prior()
    )
    # after a jump of 8 N that comes half a sample of 10 ms earlier
    assert 5e-3 < float(moved.abs().max()) < 2e-2
    assert "held_between_samples" not in {e.name for e in (*made.effects, *other.effects)}


def test_a_ramp_or_a_sine_does_not_show_whether_it_is_held():
    assert not looks_held(plain_study().runs[1:2], ["force"])
    ramp = replace(
        plain_study().runs[0],
        command={"force": np.interp(TIME, [0.0, 1.0, 1.1, 3.0], [0.0, 0.0, 5.0, 5.0])},
    )
    assert not looks_held([ramp], ["force"])


def test_a_test_run_has_no_say_in_how_commands_are_held():
    assert looks_held(plain_study().runs[:1], ["force"])
    later = replace(plain_study().runs[0], use="test")
    assert not looks_held([plain_study().runs[1], later], ["force"])


IN_TIME = ["held_between_samples", "delay", "lag", "rate_limit"]
"""What a command that comes half a sample late could be taken for."""


def test_a_held_command_that_changes_all_the_time_is_told_from_a_straight_one():
    report = answer(held_cart(effects={"only": IN_TIME}))
    assert report.named == ("held_between_samples",)
    assert report.best.values["held_between_samples"] == pytest.approx(1.0, abs=0.05)


def stepped_and_swept(**changed):
    """A cart pushed by steps in two runs, and by a force that changes all the time in a third."""
    study = held_cart()
    t = study.runs[0].time_s
    steps = np.where(t % 1.0 < 0.5, 6.0, -4.0)
    runs = tuple(
        replace(r, command={"force": steps * gain}, use="fit") if gain else replace(r, use="fit")
        for r, gain in zip(study.runs, (1.0, 0.5, 0.0), strict=True)
    )
    return replace(study, runs=runs, model=described(inputs=["force"], time_step=0.01, **changed))


def test_where_a_run_does_not_show_that_it_is_held_straight_lines_are_a_cause():
    study = stepped_and_swept()
    (note,) = description_of(study).problems(study)
    assert "straight_between_samples" in note.message
    made = setup_of(study)
    model = {**study.model, "inputs": [{"name": "force", "held": False}]}
    straight = setup_of(replace(study, model=model)).model
    cause = effect(made, "straight_between_samples")
    run, q = study.runs[2], made.model.at_prior()
    size = torch.ones(1, dtype=torch.float64)
    moved, true = made.model.predict(run, q, {cause: size}), straight.predict(run, q)
    torch.testing.assert_close(moved, true, rtol=0, atol=1e-12)
    assert float((made.model.predict(run, q) - true).abs().max()) > 1e-3


def test_a_share_of_what_is_between_samples_has_a_slope_on_both_sides_of_all_of_it():
    study = stepped_and_swept()
    made = setup_of(study)
    cause, q = effect(made, "straight_between_samples"), made.model.at_prior()
    at = [
        made.model.predict(study.runs[2], q, {cause: torch.tensor([s], dtype=torch.float64)})
        for s in (0.9, 1.0, 1.1)
    ]
    torch.testing.assert_close(at[2] - at[1], at[1] - at[0], rtol=1e-6, atol=1e-9)


WINDING = {
    "parameters": {"resistance": {"value": 2.0, "percent": 5}, "inductance": 1.6e-3},
    "inputs": [{"name": "force", "held": True}],
    "define": {},
    "states": {"i": 0},
    "rates": {"i": "(force - resistance*i)/inductance"},
    "readings": {"position_m": "i"},
    "places": [],
    "effects": {"only": ["command_offset"]},
}


def winding(**changed):
    """A current that settles within 0.8 ms, recorded each 10 ms."""
    runs = tuple(
        replace(
            r, measured=0.5 * r.command["force"][:, None] + 1e-3 * np.cos(7e3 * r.time_s)[:, None]
        )
        for r in plain_study().runs
    )
    return replace(plain_study(), runs=runs, model={"system": "ode", **WINDING, **changed})


def test_a_place_that_states_no_units_turns_where_a_channel_reads_it_as_an_angle():
    """A law that repeats each turn is asked for there, and forces are torques."""
    plain = plain_study()
    angle = replace(plain, channels=(Channel("position_m", "rad", "angle", 1e-3),))
    half = {**plain.model["places"][0], "unit": "N m"}
    stated = replace(angle, model={**plain.model, "places": [half]})
    own = replace(angle, model={**plain.model, "places": [{**half, "position_unit": "deg"}]})
    units = []
    for study in (plain, angle, stated, own):
        found = setup_of(study)
        unit = next(e.unit for e in found.effects if e.name.startswith("added_spring"))
        variable = next(v for v in found.laws.variables() if v.name == "x")
        units.append((unit, variable.unit))
    turns = ("N m/rad", "rad")
    assert units == [("N/m", "m"), turns, turns, ("N m/deg", "deg")]


def test_what_no_inertia_divides_is_an_acceleration():
    """Sizes at a swing, of which a voltage is read, were said in newtons."""
    plain = plain_study()
    swing = {
        "rates": {"x": "v", "v": "force - 9.0*sin(x) - 0.2*v"},
        "readings": {"position_m": "0.3*x"},
        "places": [{"name": "cart", "position": "x", "velocity": "v"}],
    }
    volts = replace(plain, channels=(Channel("position_m", "V", "voltage", 1e-3),))
    rates = {**plain.model["rates"], "v": "force - 9.0*x"}
    sliding = {**plain.model, "rates": rates, "places": swing["places"]}
    for study, units in (
        (replace(volts, model={**plain.model, **swing}), ("rad/s^2", "1/s", "rad")),
        (replace(plain, model=sliding), ("m/s^2", "1/s", "m")),
    ):
        by = {e.name.removesuffix("_at_cart"): e.unit for e in setup_of(study).effects}
        assert (by["dry_friction"], by["viscous_friction"], by["stop_above"]) == units
        assert by["extra_inertia"] == "-" and by["added_spring"] == "1/s^2"


@pytest.mark.parametrize(
    ("read", "unit", "friction", "stop"),
    [
        ("v", "rad/s", "N m s/rad", "rad"),  # a motor of which the speed is measured
        ("x", "rad/s", "N m s/rad/s", "rad/s"),  # its speed stands as the position
        ("v", "m/s", "N s/m", "m"),
    ],
)
def test_a_place_turns_where_its_speed_is_read_as_an_angle_s(read, unit, friction, stop):
    """Of a motor's speed it said "stop above at 1 m"."""
    channels = (Channel("position_m", unit, "speed", 1e-3),)
    plain = plain_study()
    model = {**plain.model, "readings": {"position_m": read}}
    found = setup_of(replace(plain, channels=channels, model=model))
    units = {e.name.partition("_at_")[0]: e.unit for e in found.effects}
    assert (units["viscous_friction"], units["stop_above"]) == (friction, stop)


@pytest.mark.parametrize("stated", [False, True])
def test_numbers_that_nobody_stated_are_usual_ones(stated):
    """A sticking velocity that the library assumes is no data sheet, and no finding if off."""
    plain = plain_study()
    model = {**plain.model, **({"slow_time": {"value": "2 s", "percent": 50}} if stated else {})}
    base = setup_of(replace(plain, model=model)).model.base
    usual = {re.split("_at_|@", p.name)[0] for p in base if p.is_usual and not p.of_effect}
    assumed = {"sticking", "stop_hardness", "stop_loss", "stiffening_bend", "play_start"}
    assert usual == assumed | (set() if stated else {"slow_time"})


def test_equations_too_fast_for_the_samples_are_stepped_more_often():
    study = winding()
    (note,) = description_of(study).problems(study)
    assert note.severity == "note" and "time_step" in note.where
    made = setup_of(study).model
    run = study.runs[0]
    predicted = made.predict(run, made.at_prior())
    assert bool(torch.isfinite(predicted).all())
    assert made.frame["steps_per_sample"] >= 8
    frozen = setup_of(replace(study, frame=made.frame)).model
    torch.testing.assert_close(frozen.predict(run, frozen.at_prior()), predicted)


def test_steps_are_tried_once_for_the_check_and_the_set_up(monkeypatch):
    """Both simulated the plain model, and asked twice whether a command moves all the time."""
    tried, asked = [], []
    away, moves = mends._runs_away, reading.moves_on
    monkeypatch.setattr(mends, "_runs_away", lambda *a: tried.append(a) or away(*a))
    monkeypatch.setattr(reading, "moves_on", lambda *a: asked.append(a) or moves(*a))
    study = winding(inputs=[{"name": "force"}])
    description = description_of(study)
    notes = description.problems(study)
    assert any("are taken" in str(note) for note in notes) and len(asked) == 1
    first = len(tried)
    parts = description_of(study).setup(study).model.frame["steps_per_sample"]
    assert len(tried) == first == np.log2(parts)
    slower = replace(study, model={**study.model, "rates": {"i": "(force - resistance*i)/0.5"}})
    assert setup_of(slower).model.frame["steps_per_sample"] == 1  # other formulas are tried


def test_a_command_in_percent_has_its_dead_band_in_percent():
    commands = (Command("force", unit="-", shown_unit="%"),)
    made = setup_of(replace(plain_study(), commands=commands))
    dead = effect(made, "dead_band")
    assert (dead.unit, dead.shown_unit, dead.shown_times) == ("command", "%", 100.0)


def test_nothing_is_named_where_nothing_is_hidden():
    report = answer(cart_study())
    assert report.named == ()
    assert report.verdict == "none"


def test_a_cause_of_ones_own_is_found():
    own = {
        "own": [
            {
                "name": "wind_up",
                "adds_to": "v",
                "term": "-a*x*abs(v)/m",
                "size": "a",
                "unit": "N s/m^2",
                "typical": 1.0,
                "form": "Force -size x |v|.",
            }
        ],
        "only": ["wind_up", "dry_friction", "cubic_stiffness", "lag"],
    }
    report = answer(cart_study(force=lambda x, v: -5.0 * x * abs(v), model=described(effects=own)))
    assert report.named == ("wind_up",)
    assert report.best.values["wind_up"] == pytest.approx(5.0, rel=0.05)


def test_own_causes_change_definitions_parameters_and_add_states():
    model = described(
        define={"pull": "2*force/2"},
        rates={"x": "v", "v": "(pull - c*v - k*x)/m"},
        effects={
            "own": [
                {"name": "weak", "multiplies": "pull", "term": "1 - size", "typical": 0.1},
                {"name": "soft", "changes": {"k": "k*(1 - size)"}, "typical": 0.1},
                {"name": "far", "changes": {"position_m": "position_m + size"}, "typical": 0.1},
                {
                    "name": "slow",
                    "multiplies": "pull",
                    "term": "1 + size*z",
                    "states": {"z": {"rate": "(x - z)/0.2"}},
                    "typical": 0.1,
                },
            ]
        },
    )
    study = replace(plain_study(), model=model)
    s, run = setup_of(study), plain_study().fit_runs[2]
    q = s.model.at_prior()

    def moved(name, size):
        return s.model.predict(run, q, {effect(s, name): torch.tensor([size]).double()})[:, 0]

    before = s.model.predict(run, q)[:, 0]
    torch.testing.assert_close(moved("weak", 0.25), 0.75 * before)  # a linear system
    torch.testing.assert_close(moved("far", 0.25), before + 0.25)
    soft = setup_of(replace(study, model=described(parameters={**model["parameters"], "k": 30.0})))
    torch.testing.assert_close(
        moved("soft", 0.25), soft.model.predict(run, soft.model.at_prior())[:, 0]
    )
    u = run.command["force"]

    def rate(t, y):
        pull = np.interp(t, TIME, u) * (1.0 + 0.5 * y[2])
        return [y[1], pull - 0.8 * y[1] - 40.0 * y[0], (y[0] - y[2]) / 0.2]

    # from sample to sample, for at a sample the force has a corner that no order survives
    states = [np.zeros(3)]
    for interval in itertools.pairwise(TIME):
        y = solve_ivp(rate, interval, states[-1], rtol=1e-8, atol=1e-10).y[:, -1]
        states.append(y)
    exact = np.array(states)[:, 0]
    swings = np.abs(exact).max() + np.abs(u).max() * (1.0 + 0.5 * np.abs(states).max()) / 40.0
    found = moved("slow", 0.5).numpy()
    assert np.abs(found - exact).max() < left_out(np.sqrt(40.0)) * swings


def test_keys_of_before_are_read_as_those_of_today_and_check_says_so():
    old = {"name": "stop", "adds_to": "v", "term": "-size*v", "typical": 0.1}
    new = {**old, "one_sided": True, "kink": True, "like": ["a brake"]}
    old |= {"signed": False, "smooth": False, "also_looks_like": ["a brake"]}
    was, now = (cart_study(model=described(effects={"own": [block]})) for block in (old, new))
    effects = [effect(setup_of(study), "stop") for study in (was, now)]
    for name in ("signed", "smooth", "also_looks_like", "typical", "form"):
        assert getattr(effects[0], name) == getattr(effects[1], name)
    assert not effects[0].signed and not effects[0].smooth
    notes = [p for p in description_of(was).problems(was) if p.severity == "note"]
    assert [p.where.rpartition(".")[2] for p in notes] == ["signed", "smooth", "also_looks_like"]
    assert "one_sided: true" in notes[0].message and "kink: true" in notes[1].message
    assert not [p for p in description_of(now).problems(now) if "stop" in p.message]
    both = cart_study(model=described(effects={"own": [{**old, "one_sided": True}]}))
    with pytest.raises(ValueError, match="signed is the old name of one_sided"):
        setup_of(both)


def test_values_per_run_and_from_the_data():
    model = described(
        states={"x": {"value": "0 mm", "sd": "20 mm", "per": "run"}, "v": "0"},
        define={"shown": "rest_position_m + x"},
        readings={"position_m": "shown"},
        rest={"until_s": "0.2"},
    )
    moved = replace(plain_study().runs[0], measured=plain_study().runs[0].measured + 0.5)
    s = setup_of(replace(plain_study(), runs=(moved, *plain_study().runs[1:]), model=model))
    starts = [p for p in s.model.base if p.name.startswith("x_start@")]
    assert [p.name for p in starts] == [f"x_start@{r.name}" for r in plain_study().runs]
    assert {(p.sd, p.unit) for p in starts} == {(0.02, "m")}
    assert s.model.predict(moved, s.model.at_prior())[0, 0] == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize(
    ("level", "message"),
    [
        ("400 mbar", "states level as text, '400 mbar': write a number, or with its unit"),
        (None, "setup of run step does not state level"),
    ],
)
def test_a_fact_that_is_no_number_of_every_run_is_told(level, message):
    facts = [
        {} if level is None else {"level": level},
        *({"level": 1.0} for _ in plain_study().runs[1:]),
    ]
    runs = tuple(replace(r, setup=f) for r, f in zip(plain_study().runs, facts, strict=True))
    model = described(rates={"x": "v", "v": "(level*force - c*v - k*x)/m"})
    with pytest.raises(ValueError, match=message):
        setup_of(replace(plain_study(), runs=runs, model=model))


def test_a_start_that_runs_shared_is_told_anew_where_each_has_its_own(tmp_path):
    once = {"states": {"x": {"value": "0 mm", "sd": "20 mm"}, "v": "0"}}
    shared = replace(plain_study(), model=described(**once), folder=tmp_path)
    model = setup_of(shared).model
    assert "x_start" in {p.name for p in model.base}
    entries = {
        p.name: {"value": float(p.value_at(q)), "sd": p.sd, "unit": p.unit}
        for p, q in zip(model.base, model.at_prior() + 1.0, strict=True)
    }
    path = tmp_path / "extended_model.yaml"
    said = {"model": model.name, "study": shared.name, "verdict": "none", "prepared_at": None}
    path.write_text(yaml.safe_dump({**said, "parameters": entries, "effects": {}}))
    own = {"states": {"x": {"value": "3 mm", "sd": "20 mm", "per": "run"}, "v": "0"}}
    again = load_extended(path, replace(shared, model=described(**own)))
    at = {p.name: p.value for p in again.base}
    assert at[f"x_start@{plain_study().runs[0].name}"] == pytest.approx(
        0.003
    )  # not what the others had
    assert at["m"] == pytest.approx(entries["m"]["value"])


def risen(stated, starts_at_s):
    """A reading that stands 0.1 above its mean at rest, which is 0.25 until 0.1 s."""
    time = np.arange(0.0, 1.0, 0.02)
    reading = np.where(time <= 0.1, 0.25, 0.35)[:, None]
    kept = time >= starts_at_s
    setup = {} if stated is None else {"rest_height": stated}
    run = Run("late", time[kept], reading[kept], {}, "late", setup=setup)
    model = {
        "system": "ode",
        "states": {"risen": 0.1},
        "rates": {"risen": "0*gain"},
        "parameters": {"gain": {"value": 1.0, "sd": 0.1}},
        "readings": {"height": "rest_height + risen"},
        "rest": {"until_s": 0.1},
    }
    return Study("heights", "ode", (Channel("height", "m", "position", 1e-3),), (run,), model=model)


def predicted(study):
    model = setup_of(study).model
    return model.predict(study.runs[0], model.at_prior())[:, 0]


def test_a_run_that_begins_after_its_rest_states_what_it_rested_at():
    before, after = predicted(risen(None, 0.0)), predicted(risen(0.25, 0.5))
    assert before[-1] == pytest.approx(0.35, abs=1e-12)
    np.testing.assert_allclose(after, before[-len(after) :], rtol=0, atol=1e-12)


def test_a_run_that_begins_after_its_rest_is_told_what_to_state():
    with pytest.raises(ValueError, match=r"no sample of height.*rest_height: \.\.\."):
        predicted(risen(None, 0.5))


def test_a_run_that_begins_after_its_rest_has_that_of_the_fitted_runs():
    """As where the last third of a record is judged by a model that was fitted to the first two."""
    whole = risen(None, 0.0)
    frame = setup_of(whole).model.frame
    assert frame["rests"] == {"height": pytest.approx(0.25)}
    late = replace(risen(None, 0.5), frame=frame)
    np.testing.assert_allclose(predicted(late), predicted(whole)[-25:], rtol=0, atol=1e-12)
    # a mean of its own is nearer to it, and runs that rest at several readings tell none
    assert predicted(replace(risen(0.3, 0.5), frame=frame))[-1] == pytest.approx(0.4, abs=1e-12)
    other = replace(whole.runs[0], name="other", measured=whole.runs[0].measured + 0.2)
    assert setup_of(replace(whole, runs=(*whole.runs, other))).model.frame["rests"] == {}
