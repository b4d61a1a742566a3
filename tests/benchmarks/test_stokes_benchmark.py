"""benchmarks/stokes.py at tiny size: it runs, is kept, resumed and reported, whatever the times."""

import json

import pytest

from benchmarks import stokes, stokes_tables
from tests.optional import needs

needs("matplotlib", reason="the benchmark draws figures")


TINY = stokes.Plan(
    devices=stokes.DevicePlan(
        names=("amplifier", "switch"), resolution=0.25, threads=(1,), repetitions=1
    ),
    scaling=stokes.ScalingPlan(cells=(4, 6), threads=1, repetitions=1),
    iterative=stokes.ScalingPlan(cells=(4,), threads=1, repetitions=1),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("bench_stokes")


@pytest.fixture(scope="module")
def results(out):
    stokes.BENCHMARK.run(TINY, out)
    return json.loads((out / "results.json").read_text())


def test_all_stages_report(out, results):
    assert set(results) == {"machine", "plan", *stokes.BENCHMARK.stages}
    amplifier, switch = results["devices"]
    assert (amplifier["shape"], switch["shape"]) == ([16, 12], [16, 16, 8])
    assert (amplifier["num_states"], switch["num_states"]) == (1, 2)
    for row in [*results["devices"], *results["scaling"]]:
        assert "failed" not in row
        assert row["both_wall_s"]["count"] == row["forward_cpu_s"]["count"] == 1
        assert row["both_cpu_s"]["median"] > 0.0
        assert row["num_nodes"] > 0
    (iterative,) = results["iterative"]
    assert "failed" not in iterative
    report = (out / "report.md").read_text()
    assert report.count("| amplifier |") == 1
    assert "![scaling](scaling.png)" in report
    assert (out / "scaling.png").stat().st_size > 10_000


def test_parts_are_kept(out, results):
    again = stokes.BENCHMARK.run(TINY, out, resume=True)
    assert again["devices"] == results["devices"]
    assert again["scaling"] == results["scaling"]


def test_flows_that_were_iterated_have_no_rate_of_a_factor(results):
    row = {k: v for k, v in results["devices"][0].items() if k != "factor_gflops"}
    assert stokes_tables.device_table([row])[-1].startswith("| amplifier | 16 x 12 |")


def test_exponents_are_slopes():
    def row(nodes: int) -> dict:
        return {
            "num_nodes": nodes,
            "forward_cpu_s": {"median": 1e-9 * nodes**1.5},
            "both_cpu_s": {"median": 1e-9 * nodes**2.0},
            "memory_peak_B": 7e3 * nodes**1.25,
        }

    small = {**row(100), "memory_peak_B": 1e9}  # below LARGE: fixed costs, left out
    found = stokes_tables.exponents([small, *map(row, (2000, 4000, 8000)), {"failed": "no memory"}])
    assert found["forward_cpu_s"] == pytest.approx(1.5)
    assert found["both_cpu_s"] == pytest.approx(2.0)
    assert found["memory_peak_B"] == pytest.approx(1.25)


def test_command_line(capsys):
    plan, args = stokes.parse(
        [
            "--quick",
            "--devices",
            "gate",
            "--threads",
            "1",
            "--max-cells",
            "12",
            "--stages",
            "scaling",
        ]
    )
    assert plan.devices.names == ("gate",)
    assert plan.devices.threads == (1,)
    assert plan.scaling.cells == (8, 12)
    assert args.stages == ["scaling"]
    for wrong in (["--repetitions", "0"], ["--threads", "0"]):
        with pytest.raises(SystemExit):
            stokes.parse(wrong)
    assert "--threads must lie between 1 and" in capsys.readouterr().err
