"""Thesis Table 4.4 of ours: all applications by all solvers, part after part, resumable."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core import DiffsimError
from diffsim.core.files import write_json_atomic, write_text_atomic
from examples.applications.application import SOLVERS, Application, solver_options
from examples.applications.minimize import minimize
from examples.applications.normalize import normalized, random_losses

NAMES = ("plant", "bouncing_ball", "bunny", "routing_tendon", "torus", "quadruped", "cow")
OURS = "projective_dynamics"


def load(name: str) -> Any:
    """The module of an application's script."""
    path = Path(__file__).with_name(f"{name}.py")
    spec = importlib.util.spec_from_file_location(f"application_{name}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError(f"no application {name!r}: {path} does not exist")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def row(
    name: str,
    solver: str,
    out: Path,
    *,
    quick: bool,
    evaluations: int | None,
    first: Sequence[float] | None = None,
) -> dict[str, Any]:
    """Optimize one application by one solver; what is on record is not computed again.

    ``first`` is where to begin instead of the application's own first guess or random starts.
    """
    module = load(name)
    application: Application = module.build(solver_options(solver, rtol=module.RTOL), quick)
    if first is not None:
        begin = dataclasses.replace(application.parameters, first=np.array(first))
        application = dataclasses.replace(application, parameters=begin, num_starts=1)
    folder = out / name
    limit = evaluations or (8 if quick else module.MAX_EVALUATIONS)
    base = {"name": name, "solver": solver, "dofs": application.num_dofs}
    try:
        found = minimize(
            application,
            max_evaluations=limit,
            record=folder / f"{solver}.jsonl",
            progress=True,
        )
    except DiffsimError as err:
        return {**base, "failure": " ".join(str(err).split())}
    made = found.evaluations[found.num_starts :]
    good = [e for e in made if not e.failure]
    base |= {
        "steps": len(application.motion(np.array(found.best.values))) - 1,
        "elements": application.body.mesh.num_elements,
        "dt": application.body.dt,
        "oracle": application.oracle,
        "evaluations": len(made),
        "failed": len(made) - len(good),
        "converged": found.converged,
        "message": found.message,
        "first": made[0].values,
        "best": dataclasses.asdict(found.best),
    }
    for key in ("forward_s", "backward_s", "forward_cpu_s", "backward_cpu_s"):
        base[key] = float(np.median([getattr(e, key) for e in good]))
    if solver == OURS:
        tried = found.evaluations[: found.num_starts]
        losses = random_losses(application, record=folder / "random.jsonl", tried=tried)
        base["random_loss"], base["random_count"] = float(np.mean(losses)), len(losses)
    return base


def make(
    out: Path,
    *,
    names: Sequence[str] = NAMES,
    solvers: Sequence[str] = tuple(SOLVERS),
    quick: bool = False,
    evaluations: int | None = None,
    baseline_evaluations: int | None = None,
) -> list[dict[str, Any]]:
    """All rows; ``table.json`` and ``table.md`` are written after each.

    ``baseline_evaluations`` limits those of the Newton baselines only, where their seconds per
    evaluation are wanted rather than where they end. They begin
    where ours began, at the best of its random starts if there are any.
    """
    rows: list[dict[str, Any]] = []
    for name in names:
        first = None
        for solver in (OURS, *[s for s in solvers if s != OURS]):
            limit = evaluations if solver == OURS else baseline_evaluations or evaluations
            rows.append(row(name, solver, out, quick=quick, evaluations=limit, first=first))
            first = rows[-1].get("first", first) if solver == OURS else first
            write_json_atomic(out / "table.json", rows)
            write_text_atomic(out / "table.md", markdown(rows))
    return rows


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table: a line per application and solver."""
    lines = [
        "| application | DoF | solver | forward CPU s | backward CPU s | evaluations | normalized "
        "loss | against ours |",
        "|---|---|---|---|---|---|---|---|",
    ]
    ours = {r["name"]: r for r in rows if r["solver"] == OURS and "failure" not in r}
    for r in rows:
        head = f"| {r['name']} | {r['dofs']:,} | {r['solver'].replace('_', ' ')} |"
        if "failure" in r:
            lines.append(f"{head} failed: {r['failure']} | | | | |")
            continue
        reference = ours.get(r["name"])
        loss = ratio = "-"
        if reference is not None:
            desired = reference["oracle"]
            desired = reference["best"]["loss"] if desired is None else desired
            loss = f"{normalized(r['best']['loss'], reference['random_loss'], desired):.2g}"
            ratio = f"{_cost(r) / _cost(reference):.1f}x"
        note = f" ({r['failed']} failed)" if r["failed"] else ""
        note += "" if r["converged"] else " (limit)"
        lines.append(
            f"{head} {r['forward_cpu_s']:.3g} | {r['backward_cpu_s']:.3g} | "
            f"{r['evaluations']}{note} | {loss} | {ratio} |"
        )
    return "\n".join(lines) + "\n"


def _cost(r: dict[str, Any]) -> float:
    return r["forward_cpu_s"] + r["backward_cpu_s"]
