"""The benchmark of all copter stages runs, and its gradients are right."""

from dataclasses import replace

import pytest
import torch

from benchmarks.copter import (
    BENCHMARK,
    QUICK,
    codesign_part,
    collect,
    flight_part,
    mass_layer,
    report,
)
from benchmarks.copter_control import gradient_error, measure
from benchmarks.copter_flight import passes, row
from benchmarks.harness import Seconds, Store


def test_a_wrong_gradient_is_seen():
    layer, args = mass_layer("quadcopter")

    def wrong(s):
        mass, *rest = layer(s)
        return (mass.detach() + 0.999 * (mass - mass.detach()), *rest)

    assert gradient_error(wrong, args, 1e-3) > 1e-7


def test_stages_and_report(tmp_path):
    names = [p.name for stage in BENCHMARK.stages.values() for p in stage(QUICK)]
    assert len(names) == len(set(names)) == 1 + 2 * len(QUICK.batches) + 4
    store = Store(tmp_path, "code", resume=False)
    store.run([flight_part("bare", 4, 0.0), codesign_part("quadcopter, size", "joint", QUICK)])
    text = report(collect(store.results, QUICK))
    assert "| bare, 4 |" in text
    assert "| quadcopter, size, joint | +66.7 %" in text


def test_command_writes_what_it_measured(tmp_path):
    plan = replace(QUICK, batches=(2,), seconds=0.0)
    results = BENCHMARK.run(plan, tmp_path, stages=["flight"])
    assert set(results["flight"]) == {"bare, 2", "drag, wind, lag, 2"}
    assert "codesign" not in results
    assert "| bare, 2 |" in (tmp_path / "report.md").read_text()


def test_gradients_and_rows():
    result = measure(6, seconds=0.0)
    # differences of fourth order reach 1e-11 (hover) and 1e-10 (LQR) at the steps taken
    assert result["hover_gradient_error"] < 1e-9
    assert result["lqr_gradient_error"] < 1e-8
    assert result["lqr_difference_from_scipy"] < 1e-10
    assert all(row["median"] > 0.0 for row in result["milliseconds"].values())


@pytest.mark.parametrize("kind", ["bare", "drag, wind, lag"])
def test_the_quadcopter_stays_in_the_air(kind):
    torch.manual_seed(0)
    forward = passes(3, 1000, kind, 1)["forward"]
    height = -forward()[:, -1, 2]
    assert bool((height.abs() < 1.0).all())  # a second, from within some decimeters


def test_gradients_are_there():
    grads = passes(3, 20, "bare", 1)["forward + backward"]()
    assert all(float(g.abs().max()) > 0 for g in grads)


def test_rates():
    line = row("name", [Seconds(wall=0.5, cpu=0.25)], 1_000_000)
    assert "2.000 M/s wall" in line
    assert "4.000 M/s CPU" in line
