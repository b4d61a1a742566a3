"""A demo small enough for tests, run once per session on the virtual laboratory's recordings."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from examples.demo.plan import Plan

#: Coarse and short: two fits in a few seconds. Its mesh is 30-40 % too stiff, by the locking that
#: the mesh study measures and the tests below take out again.
TINY = Plan(
    cells=(6, 2, 2),
    dt_s=5e-3,
    fit_s=0.6,
    max_evaluations=8,
    mesh_cells=((6, 2, 2), (10, 4, 4)),
    mesh_poissons_ratios=(0.499, 0.45),
    damping_dt_s=(1e-2, 5e-3),
)


#: All stages, pages and files, a fit of two simulations.
SHORT = replace(
    TINY,
    cells=(4, 1, 1),
    dt_s=1e-2,
    fit_s=0.3,
    max_evaluations=2,
    mesh_cells=((4, 1, 1), (6, 2, 2)),
)


@pytest.fixture(scope="session")
def plan(request: pytest.FixtureRequest) -> Plan:
    """For what does not look at numbers; where stories run, the plan of their demo."""
    return SHORT if "not story" in request.config.option.markexpr else TINY


@pytest.fixture(scope="session")
def short_run(plan: Plan, request: pytest.FixtureRequest) -> tuple[Path, dict[str, Any]]:
    if plan is TINY:
        return request.getfixturevalue("virtual_run")
    return run_of(plan, request.getfixturevalue("tmp_path_factory"))


@pytest.fixture(scope="session")
def virtual_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    return run_of(TINY, tmp_path_factory)


def run_of(plan: Plan, factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and results of a demo without measured data."""
    pytest.importorskip("matplotlib", reason="the demo's page needs the extra viz")
    pytest.importorskip("jinja2", reason="the demo's page needs the extra viz")
    from examples import demo

    out = factory.mktemp("demo") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("examples.demo.story.find_dataset", lambda *_: None)
        results = demo.run(out=out, plan=plan, threads=2)
    return out, results
