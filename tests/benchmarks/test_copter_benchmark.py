"""The benchmark of all copter stages runs, and its gradients are right."""

from dataclasses import replace

from benchmarks.copter import (
    BENCHMARK,
    QUICK,
    codesign_part,
    collect,
    flight_part,
    mass_layer,
    report,
)
from benchmarks.copter_control import gradient_error
from benchmarks.harness import Store


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
