"""Benchmarks of soft bodies at tiny size: they run, methods agree, halved steps come nearer."""

import json
import math

import pytest

from benchmarks import soft_materials, soft_mujoco

TINY = soft_materials.Plan(
    materials=("neo_hookean", "stvk"),
    kinds=("tet",),
    rtols=(1e-8,),
    widths=(1,),
    num_steps=2,
    repetitions=1,
)


def test_report_and_agreement(tmp_path):
    soft_materials.BENCHMARK.run(TINY, tmp_path)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [p["material"] for p in results["parts"]] == ["neo_hookean", "stvk"]
    for part in results["parts"]:
        assert [row["method"] for row in part["rows"]] == list(soft_materials.METHODS)
        for row in part["rows"]:
            assert row["converged"]
            assert row["gradient_apart"] < 1e-5  # steps and adjoints stop at 1e-8 of their scales
            assert row["forward_ratio"]["median"] > 0.0
    text = (tmp_path / "report.md").read_text()
    assert text.count("| tet |") == 8
    assert "Machine: cpu:" in text or "cpu" in text


def test_command_line():
    plan, args = soft_materials.parse(["--quick", "--materials", "stvk", "--rtols", "1e-3"])
    assert plan.materials == plan.large_materials == ("stvk",)
    assert plan.rtols == (1e-3,)
    assert plan.widths == soft_materials.QUICK.widths
    assert not args.resume


@pytest.fixture
def ours(monkeypatch):
    """Our methods alone, on a motion that a coarse beam has soon."""
    mine = {name: m for name, m in soft_mujoco.METHODS.items() if m.integrator is not None}
    monkeypatch.setattr(soft_mujoco, "METHODS", mine)
    monkeypatch.setattr(soft_mujoco, "AT", (1, 2))
    return soft_mujoco.measure((4, 1, 1), 30.0, 1, 1)


def test_halved_steps_are_nearer_and_nothing_is_far(ours):
    rows = {(row.method, row.dt): row.mean for row in ours}
    idle = [row.mean for row in ours if math.isnan(row.dt)]
    assert len(idle) == 2 and min(idle) > 0.2
    assert next(row.mean for row in ours if row.method.startswith("exact")) < 1e-3
    assert min(row.mean for row in ours if row.dt < 1e-3) < 0.1 * min(idle)
    for name in soft_mujoco.METHODS:
        long, short = (mean for (method, _), mean in rows.items() if method == name)
        assert short < long


def test_table_and_figure(ours):
    text = soft_mujoco.table(ours)
    assert "| stays twisted |" in text and "nan" not in text
    (ax,) = soft_mujoco.draw(ours, "a beam").axes
    labels = [line.get_label() for line in ax.get_lines()]
    named = [label.rsplit(", ", 1) for label in labels[: len(soft_mujoco.METHODS)]]
    assert [name for name, _ in named] == list(soft_mujoco.METHODS)
    assert named[0][1] == "10 to 5 ms"
