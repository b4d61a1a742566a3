"""Two devices of one type in one study: what they share, what differs, and by how much."""

import json
from dataclasses import dataclass, field

import numpy as np
import pytest

from diffsim.cli import main
from diffsim.diagnose.judge.apart import apart_rows, apart_words
from diffsim.identify.model_file import read_extended
from diffsim.identify.ranges import Range

CLOCK = 0.01 * np.arange(200)  # s
FRICTION = {"left": 0.06, "right": 0.12}  # N m: all else is alike
STIFFNESS, DAMPING, INERTIA, NOISE = 8.0, 0.3, 0.04, 1e-3
STUDY = """
name: servos
model:
  system: ode
  states: {q: 0, w: 0}
  inputs: [{name: goal, held: true}]
  parameters:
    stiffness: {value: 7 N m/rad, percent: 30, per: servo}
    damping: {value: 0.4 N m s/rad, percent: 50}
    friction: {value: 0.05 N m, percent: 80, per: servo}
    inertia: 0.04 kg m^2
  rates: {q: w, w: (stiffness*(goal - q) - damping*w - friction*tanh(w/0.05))/inertia}
  readings: {angle: q}
  time_step: 5 ms
  effects: {only: [delay]}
  effort: {unlisted_laws: false}
channels: [{name: angle, unit: rad, sd: 0.001}]
commands: [{name: goal, unit: rad}]
runs: [{file: "{servo}.csv", setup: {servo: "{servo}"}}]
"""


def swing(goal, friction):
    """Angles of a servo by small explicit steps, (num_samples,) [rad]."""
    angle, speed, angles = 0.0, 0.0, []
    for target in goal:
        angles.append(angle)
        for _ in range(20):
            torque = STIFFNESS * (target - angle) - DAMPING * speed
            speed += 5e-4 * (torque - friction * np.tanh(speed / 0.05)) / INERTIA
            angle += 5e-4 * speed
    return np.array(angles)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servos")
    goal, rng = 0.4 * np.sin((2.0 + 1.5 * CLOCK) * CLOCK), np.random.default_rng(0)
    for servo, friction in FRICTION.items():
        angle = swing(goal, friction) + NOISE * rng.normal(size=len(CLOCK))
        table, header = np.stack([CLOCK, goal, angle], 1), "time_s,goal,angle"
        np.savetxt(folder / f"{servo}.csv", table, delimiter=",", header=header, comments="")
    (folder / "study.yaml").write_text(STUDY)
    return folder


def test_the_one_number_that_differs_is_told_with_its_size(folder, capsys):
    assert main(["diagnose", "explain", str(folder), "--quick", "--out", str(folder / "out")]) == 0
    said = capsys.readouterr().out
    assert "more friction than servo left" in said
    assert "No difference is seen in stiffness." in said
    assert "One number for all: damping." in said
    rows = json.loads((folder / "out" / "report.json").read_text())["apart"]
    (row,) = [r for r in rows if (r["name"], r["label"]) == ("friction", "right")]
    assert row["over"]["low"] < FRICTION["right"] - FRICTION["left"] < row["over"]["high"]
    assert {r["name"] for r in rows if r["differs"]} == {"friction"}
    saved = read_extended(folder / "out")  # the file alone tells the same
    assert [r.differs for r in apart_rows(saved, saved.units)] == [r["differs"] for r in rows]
    assert "What each servo has of its own" in (folder / "out" / "report.html").read_text()


@dataclass(frozen=True)
class Given:
    """Numbers as if they were fitted."""

    values: dict
    sd: dict
    ranges: dict
    correlation: dict = field(default_factory=dict)

    def correlation_of(self, a, b):
        return 1.0 if a == b else self.correlation.get(frozenset((a, b)), 0.0)


def given(values, half, correlation=None):
    ranges = {n: Range(v, v - half, v + half) for n, v in values.items()}
    return Given(values, dict.fromkeys(values, half / 1.645), ranges, correlation or {})


def test_numbers_that_are_uncertain_alike_differ_for_sure():
    values = {"friction[servo=a]": 1.0, "friction[servo=b]": 1.2}
    apart = apart_rows(given(values, 0.3), {})
    assert not any(row.differs for row in apart)
    alike = {frozenset(values): 0.99}
    together = apart_rows(given(values, 0.3, alike), {})
    assert all(row.differs for row in together)
    # of a difference: 0.3 sqrt(2 (1 - r)); even draws of logarithms are good to a few percent
    assert together[1].over.high - 0.2 == pytest.approx(0.3 * np.sqrt(0.02), rel=0.1)


def test_a_cause_for_all_and_departures_are_summed():
    values = {"drag.all": 0.5, "drag.[servo=a]": -0.1, "drag.[servo=b]": 0.1}
    sizes = {
        row.label: row.size.value for row in apart_rows(given(values, 0.01), {"drag.all": "N"})
    }
    assert sizes == pytest.approx({"a": 0.4, "b": 0.6})


def test_the_odd_one_of_many_is_named_and_chance_is_not():
    values = {f"gain[servo={k}]": 1.0 for k in range(20)}
    values["gain[servo=7]"] = 1.5
    rng = np.random.default_rng(2)
    values = {n: v + 0.05 * rng.normal() for n, v in values.items()}
    rows = apart_rows(given(values, 1.645 * 0.05), {})
    assert [row.label for row in rows if row.differs] == ["7"]
    (said, *rest) = apart_words(rows, ())
    assert "Servo 7 has" in said and "more gain than the others" in said and not rest


def test_one_odd_group_makes_no_other_group_odd():
    values = {f"gain[servo={k}]": 1.0 + 0.01 * k for k in range(4)} | {"gain[servo=odd]": -3.0}
    rows = apart_rows(given(values, 1.645 * 0.05), {})
    assert [row.label for row in rows if row.differs] == ["odd"]


def test_nothing_is_said_where_nothing_may_differ():
    assert (
        apart_words(apart_rows(given({"gain": 1.0, "zero@run_1": 2.0}, 0.1), {}), ("gain",)) == ()
    )


def test_two_batches_are_told_apart_though_none_is_odd():
    batch = {"a": 495.0, "b": 523.0, "c": 494.0, "d": 524.0, "e": 496.0, "f": 522.0}
    values = {f"area[ring={k}]": v for k, v in batch.items()}
    rows = apart_rows(given(values, 1.645 * 8.0), {})
    (row,) = [row for row in rows if row.differs]
    assert (row.label, row.others) == ("b, d, f", "a, c, e")
    assert row.over.low < 28.0 < row.over.high
    (said,) = apart_words(rows, ())
    assert said.startswith("Ring b, d, f have 28 more area than a, c, e (")
    # as far apart as one odd group in a hundred by chance: twice as uncertain, none is told
    assert not any(row.differs for row in apart_rows(given(values, 1.645 * 16.0), {}))
