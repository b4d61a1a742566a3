"""benchmarks/soft.py at tiny size: it runs, its parts are kept, and the methods agree.

Times are not looked at.
"""

import json

import pytest

from benchmarks import soft, soft_accuracy, soft_cantilever, soft_explicit, soft_scaling
from benchmarks.harness import Part, Store
from tests.optional import needs

needs("matplotlib", reason="the benchmark draws figures")


TINY = soft.Plan(
    cantilever=soft_cantilever.Plan(
        cells=(4, 1, 1), num_steps=2, rtols=(1e-3, 1e-8), threads=(1,), repetitions=1
    ),
    scaling=soft_scaling.Plan(
        widths=(1, 2), kinds=("hex",), methods=("auto", "newton_cholesky"), num_steps=1, seconds=0.0
    ),
    explicit=soft_explicit.Plan(
        cells=(4, 1, 1), duration=0.05, directions=2, samples=3, seconds=0.0
    ),
    accuracy=soft_accuracy.Plan(
        cells=(4, 1, 1),
        num_steps=1,
        kinds=("tet",),
        poissons_ratios=(0.45,),
        volume_weights=("thesis",),
        shares=(0.1, 1.0),
    ),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("bench_soft")


@pytest.fixture(scope="module")
def results(out):
    soft.BENCHMARK.run(TINY, out)
    return json.loads((out / "results.json").read_text())


@pytest.mark.cpu(9)  # the whole benchmark at its smallest, its figures drawn
def test_all_stages_report(out, results):
    assert set(results) == {"machine", "plan", *soft.BENCHMARK.stages}
    assert {"cpu", "cores", "commit", "instruction_set", "date"} <= set(results["machine"])
    report = (out / "report.md").read_text()
    for name in soft.BENCHMARK.stages:
        assert f"![{name}]({name}.png)" in report
        assert (out / f"{name}.png").stat().st_size > 10_000
        assert (out / f"{name}.svg").read_text().startswith("<?xml")


def test_methods_agree_on_loss_and_gradient(results):
    rows = results["cantilever"]["rows"]
    assert {r["method"] for r in rows} == set(soft_cantilever.METHODS)
    assert all(r["converged"] for r in rows)
    for r in rows:
        # Residuals of rtol times the load leave errors of the same order, amplified by the
        # conditioning of the step (here below 100).
        assert r["loss_error"] < 100 * r["rtol"]
        assert r["grad_error"] < 100 * r["rtol"]
        assert r["forward_cpu_s"]["median"] > 0
        assert r["step_iters"] >= 1


def test_sizes_are_measured_in_children(results):
    rows = results["scaling"]["rows"]
    assert [(r["method"], r["num_dof"]) for r in rows] == [
        ("auto", 60), ("newton_cholesky", 60), ("auto", 243), ("newton_cholesky", 243),
    ]  # fmt: skip
    for r in rows:
        assert "skipped" not in r
        assert r["converged"]
        assert r["memory_start_B"] > 10e6
    assert {"scalar_solve_s", "block_factor_s", "gradient_s"} <= set(
        results["scaling"]["operations"][0]
    )


def test_explicit_steps_are_stable_only_where_linear_theory_says(results):
    stable = results["explicit"]["stable_step"]
    assert 0.5 < stable["dt_s"] / stable["dt_linear_s"] < 1.2
    landscapes = {r["integrator"]: r for r in results["explicit"]["landscapes"]}
    assert set(landscapes) == set(soft_explicit.INTEGRATORS)
    assert len(landscapes["implicit_euler"]["loss"]) == 2
    assert len(landscapes["implicit_euler"]["loss"][0]) == 3
    saved = {
        r["integrator"]: r["saved_B"]
        for r in results["explicit"]["costs"]
        if r["saved_B"] is not None
    }
    assert saved["semi_implicit_euler"] > saved["implicit_euler"]


def test_shares_change_iterations_only(results):
    rows = results["accuracy"]["rows"]
    assert {(r["name"], r["share"]) for r in rows} == {
        (name, share) for name in ("VOLUME_SHARE", "FIBER_SHARE") for share in (0.1, 1.0)
    }
    volume = [r for r in rows if r["name"] == "VOLUME_SHARE"]
    assert all(abs(r["loss"] / volume[0]["loss"] - 1.0) < 1e-2 for r in volume)


def test_resume_keeps_parts_of_equal_settings_only(tmp_path):
    calls = []

    def part(settings):
        return Part(
            "stage/part", settings, lambda results, say: calls.append(1) or {"n": len(calls)}
        )

    def run(settings, *, resume, fingerprint="code"):
        store = Store(tmp_path, fingerprint, resume)
        store.run([part(settings)])
        return store.results["stage/part"]["n"]

    assert run({"a": 1}, resume=False) == 1
    assert run({"a": 1}, resume=True) == 1
    assert run({"a": 2}, resume=True) == 2
    assert run({"a": 2}, resume=True, fingerprint="other code") == 3
    assert run({"a": 2}, resume=False, fingerprint="other code") == 4


def test_an_interruption_keeps_what_is_finished(tmp_path, monkeypatch):
    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(soft_cantilever, "measure_tolerance", interrupt)
    with pytest.raises(KeyboardInterrupt):
        soft.BENCHMARK.run(TINY, tmp_path, stages=["cantilever"], resume=False)
    assert json.loads((tmp_path / "results.json").read_text())["cantilever"]["rows"] == []
    assert "# Soft bodies" in (tmp_path / "report.md").read_text()


def test_thread_counts_beyond_the_machine_are_refused(capsys):
    with pytest.raises(SystemExit):
        soft.parse(["--threads", "4096"])
    assert "--threads must lie between 1 and" in capsys.readouterr().err
