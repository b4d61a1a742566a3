"""Runs that could be recorded next: within what commands can do, called so that one can do them."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data import Channel, Command, Run, Study
from diffsim.data.bank import MAX_RUNS, command_table, generated_bank

T = np.arange(200) * 0.01


MODEL = {"system": "ode", "rates": {"v": "force/(1.0 + payload_kg)"}}


def make_study(**changes) -> Study:
    runs = tuple(
        Run(
            name,
            T,
            np.ones((200, 1)),
            {"force": level * (T > 0.5), "feedback": np.sin(T)},
            name,
            order,
            setup={"payload_kg": load, "operator": name},
        )
        for order, (name, level, load) in enumerate([("a", 1.0, 0.2), ("b", 2.0, 0.5)])
    )
    commands = (
        Command("force", "N", lower=-3.0, upper=4.0, rate=500.0, shown_unit="mN"),
        Command("feedback", "V", is_measured=True),
    )
    channels = (Channel("x", "m", "position"),)
    study = Study("cart", "ode", channels, runs, model=MODEL, commands=commands)
    return replace(study, **changes)


def test_every_run_stays_within_limits_and_rate():
    bank = generated_bank(make_study())
    assert 10 <= len(bank) <= MAX_RUNS
    assert len({run.name for run in bank}) == len(bank)
    for run in bank:
        force = run.command["force"]
        assert force.shape == run.time_s.shape and run.measured.shape == (len(force), 1)
        assert force.min() >= -3.0 and force.max() <= 4.0, run.name
        if not run.name.endswith("again") and "payload" not in run.name:
            assert np.abs(np.diff(force)).max() <= 500.0 * 0.01 * (1 + 1e-9), run.name
        assert run.use == "next"


def test_names_say_what_to_do():
    names = [run.name for run in generated_bank(make_study())]
    assert "force: step to 4000 mN, 1.99 s" in names
    assert any(name.startswith("force: chirp 1.5 to ") and "Hz" in name for name in names)
    assert any("ramp up to" in name for name in names)
    assert "a again, with payload_kg = 0.5" in names and "b again, half as fast" in names
    assert not any("feedback" in name or "operator" in name for name in names)


def test_a_chirp_is_as_fast_as_the_command_can_move():
    slow = (Command("force", "N", lower=-1.0, upper=1.0, rate=10.0),)
    names = [run.name for run in generated_bank(make_study(commands=slow))]
    assert "force: chirp 1.5 to 8 Hz, 0.2 N, 1.99 s" in names  # 2 pi 8 Hz 0.2 N = 10 N/s
    assert not any(", 1 N" in name and "chirp" in name for name in names)  # 1.6 Hz: no sweep


def test_without_limits_the_range_seen_holds():
    bank = generated_bank(make_study(commands=()))
    assert max(run.command["force"].max() for run in bank) == 2.0
    assert any(run.name.startswith("feedback: ") for run in bank)


def test_the_study_may_allow_other_facts():
    bank = generated_bank(make_study(allows={"medium": ("water", "air")}))
    by_name = {run.name: run for run in bank}
    assert by_name["a again, with medium = water"].setup["medium"] == "water"
    assert by_name["a again, with medium = water"].setup["payload_kg"] == 0.2


def test_facts_that_belong_together_change_together():
    a, b = make_study().runs
    light, heavy = {"payload_kg": 0.2, "rig": "A"}, {"payload_kg": 0.5, "rig": "B"}
    runs = (replace(a, setup=light), replace(b, setup=heavy))
    model = {**MODEL, "gain": {"value": 1.0, "sd": 0.1, "per": "rig"}}
    names = [run.name for run in generated_bank(make_study(runs=runs, model=model))]
    assert "a again, with payload_kg = 0.5, rig = B" in names
    assert not any(name.endswith("rig = B") and "payload" not in name for name in names)


def test_what_flies_repeats_what_was_flown():
    bank = generated_bank(make_study(system="multicopter"))
    assert {run.name for run in bank} == {
        "a again, with payload_kg = 0.5",
        "b again, with payload_kg = 0.2",
        "a again",
        "b again",
    }
    np.testing.assert_array_equal(bank[0].measured, 1.0)  # windows may start from what was seen


def test_a_command_as_a_table_in_the_users_unit():
    study = make_study()
    run = next(r for r in generated_bank(study) if r.name.startswith("force: step to 4000"))
    lines = command_table(run, study).splitlines()
    assert lines[0] == "time_s,force (mN),feedback (V)"
    assert float(lines[-1].split(",")[1]) == pytest.approx(4000.0)
