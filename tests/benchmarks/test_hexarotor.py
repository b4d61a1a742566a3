"""The comparison of L-BFGS and CMA-ES on a hexarotor: same starts, same time, honest table."""

import numpy as np
import pytest

from benchmarks.hexarotor import Counted, items, run, table
from diffsim.copter.waypoints import WaypointTask


@pytest.fixture(scope="module")
def results():
    pytest.importorskip("cma")
    asked = {k: v for k, v in items([0], 0.6).items() if "weights" in k}
    return {name: run(item) for name, item in asked.items()}


def test_every_method_finds_something_within_its_time(results):
    assert {r["method"] for r in results.values()} == {"gradient", "cma", "controller only"}
    for row in results.values():
        x = np.array(row["x"])
        assert len(x) == 23 and (x >= 0.0).all() and (x <= 1.0).all()
        values = [value for _, value in row["curve"]]
        assert values == sorted(values, reverse=True) and values[-1] == row["loss"]
        assert row["curve"][-1][0] < 1.2
        assert row["loss"] == pytest.approx(WaypointTask().value(x), rel=1e-9)


def test_a_controller_alone_leaves_the_airframe(results):
    x = np.array(results["controller_only_weights_0"]["x"])
    np.testing.assert_array_equal(x[:15], WaypointTask().airframe.conventional)


def test_the_table_has_medians(results):
    rows = {
        f"gradient_weights_{k}": {**results["gradient_weights_0"], "seed": k, "loss": loss}
        for k, loss in enumerate((0.7, 0.9, 0.75))
    }
    said = table(rows)
    assert "| gradient | 23 | 0.700, 0.900, 0.750 | 0.750 |" in said
    assert said.startswith("Flat regular hexarotor, middle weights: 1.362 m.")


def test_what_cannot_be_flown_is_bad_not_an_error():
    objective = Counted(WaypointTask(num_episodes=1, seconds=0.1), 10.0)

    def broken(x):
        raise ArithmeticError("left the finite numbers")

    object.__setattr__(objective.task, "value", broken)
    assert objective.value(np.zeros(23)) == 1e4
    assert objective.best == np.inf and objective.calls == 1
