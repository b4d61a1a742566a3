"""benchmarks/contact.py at tiny size: it runs, its parts are kept, and the solvers agree.

Times are not looked at.
"""

import json

import pytest

from benchmarks import contact, contact_napkin, contact_rolling
from benchmarks.contact_scenes import VARIANTS, about, voxel_sphere
from tests.optional import needs

needs("matplotlib", reason="the benchmark draws figures")


TINY = contact.Plan(
    rolling=contact_rolling.Plan(
        spacing=0.025, voxels=4, num_steps=4, rtols=(1e-3, 1e-8), rtol=1e-6, reference_rtol=1e-10
    ),
    napkin=contact_napkin.Plan(
        cells=(6,), reaches=(0.4, 1.6), span=3, samples=2, rtol=1e-6, friction_cells=6
    ),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("bench_contact")


@pytest.fixture(scope="module")
def results(out):
    contact.BENCHMARK.run(TINY, out)
    return json.loads((out / "results.json").read_text())


def test_both_stages_report(out, results):
    assert set(results) == {"machine", "plan", *contact.BENCHMARK.stages}
    assert results["machine"]["load_average_at_end"] >= 0
    report = (out / "report.md").read_text()
    for name in contact.BENCHMARK.stages:
        assert f"![{name}]({name}.png)" in report
        assert (out / f"{name}.png").stat().st_size > 10_000
        assert (out / f"{name}.svg").read_text().startswith("<?xml")


def test_the_ball_of_cubes_is_the_theses():
    sizes = about(voxel_sphere())
    assert (sizes["num_elements"], sizes["num_dof"]) == (552, 2469)


def test_solvers_agree_on_loss_and_gradient(results):
    rows = results["rolling"]["rows"]
    assert {r["method"] for r in rows} == set(VARIANTS)
    for r in [*rows, *results["rolling"]["voxels"]["rows"]]:
        assert r["converged"]
        assert r["num_contacts"] > 0
        # Residuals of rtol leave errors of the same order times the conditioning of the rollout.
        assert r["loss_error"] < 1e3 * r["rtol"]
        assert r["grad_error"] < 1e3 * r["rtol"]


def test_kept_columns_change_no_number(results):
    rows = {(r["method"], r["rtol"]): r for r in results["rolling"]["rows"]}
    for rtol in TINY.rolling.rtols:
        assert rows["uncached", rtol]["loss"] == rows["newton_pcg", rtol]["loss"]
        assert rows["uncached", rtol]["grad_norm"] == rows["newton_pcg", rtol]["grad_norm"]


def test_friction_cases_slide_where_they_should(results):
    cases = {r["case"]: r for r in results["rolling"]["friction"]}
    assert cases["infinite friction, rolling"]["num_slipping"] == 0
    assert cases["mu = 0, slides"]["num_slipping"] == cases["mu = 0, slides"]["num_contacts"]


def test_napkin_touches_with_what_may_touch(results):
    cases = results["napkin"]["cases"]
    assert len(cases) == 3
    for case in cases:
        assert 0 < case["share"] <= case["candidates"] <= 0.5
        assert [r["method"] for r in case["rows"]] == list(VARIANTS)
        assert all(r["converged"] for r in case["rows"])


def test_repetitions_below_one_are_refused(capsys):
    with pytest.raises(SystemExit):
        contact.parse(["--repetitions", "0"])
    assert "--repetitions must be at least 1" in capsys.readouterr().err
