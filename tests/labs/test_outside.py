"""Cases made by other people's simulators: a few always, all of them where time does not matter."""

import numpy as np
import pytest
from scipy.signal import lsim

from diffsim.data.study import Run
from labs.outside import __main__ as outside_cases
from labs.outside.__main__ import SEED, held_against, judged, table
from labs.outside.case import Case
from labs.outside.catalog import CASES
from labs.outside.mechanisms import CART, FILTERED, MOTOR, TIME, Rig, fine_step

CHEAP = ("pendulum_spring", "cart_as_described")


def case(kind, hidden=None, also=()):
    return Case(None, None, kind, hidden or {}, also)


def answer(verdict, named=(), rivals=(), size=None):
    intervals = {n: {"size": size} for n in named}
    return {
        "verdict": verdict,
        "named": list(named),
        "rivals": list(rivals),
        "intervals": intervals,
    }


@pytest.mark.parametrize(
    ("hidden", "given", "right", "wrong_name", "false_alarm"),
    [
        (case("null"), answer("none"), True, False, False),
        (case("null"), answer("named", ["lag"]), False, True, True),
        (case("null"), answer("unknown"), False, False, True),
        (case("single", {"lag": 0.1}), answer("named", ["lag"]), True, False, False),
        (case("single", {"lag": 0.1}), answer("named", ["gain"]), False, True, False),
        (case("single", {"lag": 0.1}), answer("named", ["gain", "lag"]), False, True, False),
        (
            case("single", {"lag": 0.1}),
            answer("ambiguous", ["gain"], [["lag"]]),
            True,
            False,
            False,
        ),
        (case("single", {"lag": 0.1}, ("delay",)), answer("named", ["delay"]), True, False, False),
        (case("single", {"lag": 0.1}), answer("unknown"), False, False, False),
        (case("outside"), answer("unknown"), True, False, False),
        (case("outside"), answer("named", ["lag"]), False, True, False),
        (case("outside"), {"verdict": "failed"}, False, False, False),
    ],
)
def test_what_counts_as_right(hidden, given, right, wrong_name, false_alarm):
    found = held_against(hidden, given)
    assert (found["right"], found["wrong_name"], found["false_alarm"]) == (
        right,
        wrong_name,
        false_alarm,
    )


def test_a_size_counts_where_its_truth_is_a_number():
    near = answer("named", ["lag"], size=(0.11, 0.095, 0.125))
    assert held_against(case("single", {"lag": 0.1}), near)["inside"] is True
    assert held_against(case("single", {"lag": 0.2}), near)["inside"] is False
    assert held_against(case("single", {"lag": None}), near)["inside"] is None


def test_totals_leave_out_what_no_data_could_show():
    row = {"case": "a", "hidden": {"lag": 0.1}, "kind": "single", "verdict": "none", "cpu_s": 1.0}
    row |= {"right": False, "wrong_name": False, "false_alarm": False, "inside": None}
    text = table([{**row, "lambda": 3.0}, {**row, "lambda": 9.0, "right": True}])
    assert "right at lambda >= 8: 1 of 1" in text


def test_a_package_that_is_not_installed_leaves_its_cases_out(monkeypatch, capsys):
    monkeypatch.setattr(outside_cases, "CASES", {"a": ("no_such_package", None)})
    assert outside_cases.main([]) == 0
    assert "a: left out, no_such_package is not installed" in capsys.readouterr().err
    assert outside_cases.main(["--only", "b"]) == 2


def test_there_are_enough_cases_of_each_kind():
    starts = [name.endswith("as_described") for name in CASES]
    assert len(CASES) >= 20 and sum(starts) >= 4
    assert {package for package, _ in CASES.values()} == {"mujoco", "rotorpy", "elastica"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in CHEAP)) for n in CASES]
)
def test_what_was_hidden_is_found(name):
    package = CASES[name][0]
    pytest.importorskip(package, reason=f"{package} is not installed")
    row = judged(name, SEED)
    assert not row["wrong_name"] and not row["false_alarm"], row
    if row["kind"] == "null" or row["lambda"] >= 8.0:
        assert row["right"], row


@pytest.mark.parametrize("lag", [0.0, 2e-4, 1.3e-3, 0.03])
def test_a_slow_motor_is_late_by_its_time_constant_alone(lag):
    """Against the linear equations, solved exactly for commands that are straight lines."""
    pytest.importorskip("mujoco")
    mass, damping, spring = 1.2, 1.0, 40.0
    motor = (FILTERED if lag else MOTOR).format(joint="rail", lag=lag)
    more = {"joint": "", "body": "", "more": "", "gx": 0.0}
    xml = CART.format(
        step=fine_step(lag), mass=mass, damping=damping, spring=spring, actuator=motor, **more
    )
    force = np.interp(TIME, [0.0, 0.3, 1.0, 1.02, 3.0], [0.0, 3.0, 3.0, -2.0, -1.0])
    run = Run("run", TIME, np.zeros((len(TIME), 1)), {"force_N": force}, "run")
    seen = Rig(xml, read=("place",)).record(run)[:, 0]

    whole = np.polymul([lag, 1.0], [mass, damping, spring])
    _, exact, _ = lsim(([1.0], whole), force, TIME)
    # what 0.1 ms more of lag would move
    shift = 1e-4 * np.abs(np.gradient(exact, TIME)).max()
    assert np.abs(seen - exact).max() < 0.05 * shift
