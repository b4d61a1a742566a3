"""benchmarks/soft_materials.py at tiny size: it runs, is kept, and the methods agree."""

import json

from benchmarks import soft_materials

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
