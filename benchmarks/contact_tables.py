"""The Markdown report of benchmarks/contact.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.contact_scenes import VARIANTS
from benchmarks.plot_style import Rows
from benchmarks.soft_tables import about, number, table

NEAR = 1.1
"""Times within this factor of the best count as the best."""


def report(results: dict[str, Any], figures: Sequence[str]) -> str:
    """Tables and figures of the stages that have run."""
    sections: list[tuple[str, str, Callable[[dict[str, Any]], list[str]]]] = [
        ("rolling", "Rolling sphere (thesis fig. 4-5)", rolling),
        ("napkin", "Napkin on a ball (thesis Table 4.1)", napkin),
    ]
    lines = ["# Contact", "", *about(results["machine"])]
    lines += [
        f"Load average at the end {results['machine']['load_average_at_end']:.2f}. One thread; "
        "all times are CPU seconds. `uncached` is newton_pcg that makes columns of the constant "
        "matrix's inverse anew for every contact set."
    ]
    for name, title, write in sections:
        if name in results:
            lines += ["", f"## {title}", "", *write(results[name])]
            lines += [f"\n![{f}]({f}.png)" for f in figures if f == name]
    return "\n".join(lines) + "\n"


def rolling(stage: dict[str, Any]) -> list[str]:
    """Solvers over tolerance, on the ball of cubes, and friction."""
    reference = stage["reference"]
    lines = [
        f"{reference['num_dof']:,} DoF, {reference['num_elements']:,} hexahedra, "
        f"{reference['num_contact_nodes']} nodes that may touch. Seconds of the whole rollout. "
        f"Errors are relative to Newton-Cholesky at {reference['rtol']:.0e}; counts are means per "
        "step.",
        "",
        *method_table(stage["rows"]),
    ]
    if voxels := stage["voxels"]:
        lines += [
            "",
            f"### The thesis's mesh: {voxels['num_elements']} cubes, {voxels['num_dof']:,} DoF",
            "",
            *method_table(voxels["rows"]),
        ]
    if stage["friction"]:
        header = ("case", "forward", "backward", "iters", "contacts", "slipping", "set changes")
        cells = [
            (
                r["case"],
                number(r["forward_cpu_s"]["median"]),
                number(r["backward_cpu_s"]["median"]),
                f"{r['step_iters']:.1f}",
                f"{r['num_contacts']:.1f}",
                f"{r['num_slipping']:.1f}",
                f"{r['num_set_changes']:.2f}",
            )
            for r in stage["friction"]
        ]
        lines += ["", "### Friction (`auto`)", "", *table(header, cells)]
    return lines


def method_table(rows: Rows) -> list[str]:
    """One line per solver and tolerance."""
    header = (
        "method, rtol",
        "forward",
        "backward",
        "net",
        "loss",
        "gradient norm",
        "loss err",
        "gradient err",
        "iters",
        "solves",
        "factor.",
        "adjoint iters",
        "contacts",
    )
    return table(
        header,
        [
            (
                f"{r['method']} {r['rtol']:.0e}" + ("" if r["converged"] else " **not converged**"),
                *(number(r[f"{k}_cpu_s"]["median"]) for k in ("forward", "backward", "net")),
                number(r["loss"], 6),
                number(r["grad_norm"], 4),
                number(r["loss_error"], 2),
                number(r["grad_error"], 2),
                f"{r['step_iters']:.1f}",
                f"{r['step_solves']:.1f}",
                f"{r['step_factorizations']:.1f}",
                f"{r['adjoint_iters']:.1f}",
                f"{r['num_contacts']:.1f}",
            )
            for r in rows
        ],
    )


def napkin(stage: dict[str, Any]) -> list[str]:
    """One line per mesh and solver, one column per reach, as in Table 4.1."""
    lines = [
        "Milliseconds of CPU time per step, mean over steps in contact (all solvers take the same "
        "steps); the best of a cell and those within 10 % of it are bold. Columns: share of nodes "
        "that may touch. –: not measured, too many columns; +: stopped before all steps were done.",
    ]
    for title, sticking in (("Infinite friction", True), ("mu = 0.3", False)):
        cases = [c for c in stage["cases"] if (c["friction"] is None) == sticking]
        if cases:
            lines += ["", f"### {title}", "", *napkin_table(cases)]
    return lines


def napkin_table(cases: list[dict[str, Any]]) -> list[str]:
    """Times of some cases."""
    reaches = sorted({c["reach"] for c in cases})
    finest = max(c["cells"] for c in cases)
    share = {c["reach"]: c["candidates"] for c in cases if c["cells"] == finest}
    header = ("mesh, method", *(f"{100 * share[r]:.0f} %" for r in reaches))
    cells = []
    for width in sorted({c["cells"] for c in cases}):
        row = {c["reach"]: c for c in cases if c["cells"] == width}
        first = row[min(row)]
        cells.append(
            (
                f"**{width} x {width} x 1**, {first['num_dof']:,} DoF: share in contact",
                *(f"{100 * row[r]['share']:.0f} %" for r in reaches),
            )
        )
        for method in VARIANTS:
            cells.append((method, *(cell(row[r], method) for r in reaches)))
        cells.append(("auto used", *(chosen(row[r]) for r in reaches)))
    return table(header, cells)


def cell(case: dict[str, Any], method: str) -> str:
    """A time, marked."""
    times = {r["method"]: r["step_cpu_s"] for r in case["rows"]}
    if method not in times:
        return "–"
    full = max(r["samples"] for r in case["rows"])
    row = next(r for r in case["rows"] if r["method"] == method)
    text = number(1e3 * times[method]) + ("+" if row["samples"] < full else "")
    if not row["converged"]:
        text += " not converged"
    return f"**{text}**" if times[method] <= NEAR * min(times.values()) else text


def chosen(case: dict[str, Any]) -> str:
    """Which preconditioner auto worked with, as its counters tell."""
    row = next(r for r in case["rows"] if r["method"] == "auto")
    if row["num_factorizations"] > 0:
        return "tangent" if row["num_solves"] < 1 else "mixed"
    return "constant" if row["num_solves"] >= 1 or math.isclose(row["num_iters"], 0) else "Jacobi"
