"""The benchmark of all copter stages runs, and its gradients are right."""

import pytest

from benchmarks.copter import (
    QUICK,
    codesign_part,
    flight_layer,
    flight_part,
    mass_layer,
    parts_of,
    report,
)
from benchmarks.copter_control import gradient_error
from benchmarks.harness import Store


def test_gradients():
    # fourth-order differences at these steps reach 1e-9
    assert gradient_error(*flight_layer(), 1e-4) < 1e-8
    assert gradient_error(*mass_layer("bunny"), 1e-3) < 1e-8


def test_a_wrong_gradient_is_seen():
    layer, args = mass_layer("quadcopter")

    def wrong(s):
        mass, *rest = layer(s)
        return (mass.detach() + 0.999 * (mass - mass.detach()), *rest)

    assert gradient_error(wrong, args, 1e-3) > 1e-7


def test_stages_and_report(tmp_path):
    pytest.importorskip("cvxpy")
    names = [p.name for p in parts_of(QUICK)]
    assert len(names) == len(set(names)) == 1 + 2 * len(QUICK.batches) + 4
    store = Store(tmp_path, "code", resume=False)
    store.run([flight_part("bare", 4, 0.0), codesign_part("quadcopter, size", "joint", QUICK)])
    text = report(store.results)
    assert "| bare, 4 |" in text
    assert "| quadcopter, size, joint | +66.7 %" in text
