"""The Markdown report of benchmarks/soft.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

Rows = list[dict[str, Any]]


def report(results: dict[str, Any], figures: Sequence[str]) -> str:
    """Tables and figures of the stages that have run."""
    sections: list[tuple[str, str, Callable[[dict[str, Any]], list[str]]]] = [
        ("cantilever", "Methods over tolerance and threads (thesis fig. 4-4)", cantilever),
        ("scaling", "Mesh size", scaling),
        ("explicit", "Explicit against implicit steps (thesis fig. 4-3)", explicit),
        ("accuracy", "Weights of the constant matrix", accuracy),
    ]
    lines = ["# Soft bodies", "", *about(results["machine"])]
    for name, title, write in sections:
        if name in results:
            lines += ["", f"## {title}", "", *write(results[name])]
            lines += [f"\n![{f}]({f}.png)" for f in figures if f.startswith(name)]
    return "\n".join(lines) + "\n"


def about(machine: dict[str, Any]) -> list[str]:
    """Where it ran."""
    busy = machine["load_average_at_start"] > 0.5
    return [
        f"{machine['cpu']}, {machine['cores']} cores ({machine['caches']}), "
        f"{machine['instruction_set']}, {machine['compiler']}, torch {machine['torch']}; "
        f"commit {machine['commit']}, {machine['date']}.",
        f"Load average at the start {machine['load_average_at_start']:.2f}"
        + (": **others were using this machine, wall times are too long.**" if busy else "."),
        "Times are medians; CPU time is that of all threads. All numbers: results.json.",
    ]


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """A Markdown table; the first column is aligned left, the others right."""
    lines = ["| " + " | ".join(header) + " |", "|---" + "|---:" * (len(header) - 1) + "|"]
    return lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]


def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits without an exponent where that is readable."""
    if value is None:
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits}g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{value:.{digits - 1}e}"


def pair(row: dict[str, Any], name: str) -> str:
    """``median (q3 - q1)`` of a spread; of a single value, that."""
    value = row[name]
    if value["count"] == 1:
        return number(value["median"])
    return f"{number(value['median'])} ({number(value['q3'] - value['q1'], 1)})"


def cantilever(stage: dict[str, Any]) -> list[str]:
    """One table per thread count."""
    reference = stage["reference"]
    lines = [
        f"{reference['num_dof']:,} DoF, {reference['num_elements']:,} hexahedra. Once per body: "
        f"{reference['prepare_mesh_s'] * 1e3:.0f} ms to prepare the mesh, "
        f"{reference['prepare_factor_s'] * 1e3:.0f} ms to analyze and factor the constant matrix "
        "(not in the times below).",
        "Seconds of the whole rollout, with the interquartile range. Errors are relative to "
        f"Newton-Cholesky at {reference['rtol']:.0e}; that of the gradient is of the whole vector. "
        "Counts are means per step: outer iterations, solves with the constant factor, "
        "factorizations of the tangent; for the adjoint Krylov iterations.",
    ]
    header = (
        "method, rtol",
        "forward wall",
        "CPU",
        "backward wall",
        "CPU",
        "net wall",
        "loss err",
        "gradient err",
        "iters",
        "solves",
        "factor.",
        "adjoint iters",
        "factor.",
    )
    for threads in sorted({r["threads"] for r in stage["rows"]}):
        rows = [r for r in stage["rows"] if r["threads"] == threads]
        cells = [
            (
                f"{r['method']} {r['rtol']:.0e}" + ("" if r["converged"] else " **not converged**"),
                pair(r, "forward_wall_s"),
                number(r["forward_cpu_s"]["median"]),
                pair(r, "backward_wall_s"),
                number(r["backward_cpu_s"]["median"]),
                pair(r, "net_wall_s"),
                number(r["loss_error"], 2),
                number(r["grad_error"], 2),
                f"{r['step_iters']:.1f}",
                f"{r['step_solves']:.1f}",
                f"{r['step_factorizations']:.1f}",
                f"{r['adjoint_iters']:.1f}",
                f"{r['adjoint_factorizations']:.1f}",
            )
            for r in rows
        ]
        lines += [
            "",
            f"### {threads} thread{'s' if threads > 1 else ''}",
            "",
            *table(header, cells),
        ]
    return lines


def scaling(stage: dict[str, Any]) -> list[str]:
    """Step time and memory, exponents, single operations."""
    header = (
        "mesh, method",
        "DoF",
        "forward [s/step]",
        "backward [s/step]",
        "iters",
        "solves",
        "adjoint iters",
        "prepare [s]",
        "memory [MiB]",
    )
    rows, skipped = [], []
    for r in stage["rows"]:
        if "skipped" in r:
            skipped.append(f"- {r['kind']}, {r['num_dof']:,} DoF, {r['method']}: {r['skipped']}")
        if "forward_cpu_s" not in r:
            continue
        rows.append(
            (
                f"{r['kind']}, {r['method']}" + ("" if r["converged"] else " **not converged**"),
                f"{r['num_dof']:,}",
                pair(r, "forward_cpu_s"),
                pair(r, "backward_cpu_s"),
                f"{r['step_iters']:.1f}",
                f"{r['step_solves']:.1f}",
                f"{r['adjoint_iters']:.1f}",
                number(r["prepare_mesh_s"] + r["analyze_and_factor_s"]),
                f"{r['memory_peak_B'] / 2**20:.0f}",
            )
        )
    lines = [
        "CPU time (of all threads) per step of 10 ms from a slightly twisted shape. Memory is the "
        "peak of forward and backward above that of the imported package, the mesh included. "
        "newton_pcg runs on the constant factor, auto on what the plan chose.",
        "",
        *table(header, rows),
    ]
    if skipped:
        lines += ["", "Skipped:", "", *skipped]
    exponents = [
        (
            f"{e['kind']}, {e['method']}",
            f"{e['from']:,} to {e['to']:,}",
            *(f"{e[name]:.2f}" for name in ("forward_cpu_s", "backward_cpu_s", "memory_B")),
        )
        for e in stage["exponents"]
    ]
    lines += ["", "Exponents p of value = c DoF^p, fitted over:", ""]
    lines += table(("mesh, method", "DoF", "forward", "backward", "memory"), exponents)
    return lines + operations(stage["operations"])


def operations(rows: Rows) -> list[str]:
    """What a step is made of."""
    names = {
        "gradient_s": "elastic gradient",
        "hessian_product_s": "tangent + product",
        "scalar_analysis_s": "analyze",
        "scalar_factor_s": "factor",
        "scalar_solve_s": "solve",
        "scalar_float32_solve_s": "solve, float32",
        "block_analysis_s": "3x3 analyze",
        "block_factor_s": "3x3 factor",
        "block_solve_s": "3x3 solve",
    }
    cells = [
        (
            f"{r['kind']}, {r['num_dof']:,}",
            *(number(r[name] * 1e3) if name in r else "–" for name in names),
            *(
                number(r[name] / 2**20)
                for name in ("scalar_factor_B", "block_factor_B", "tangent_B")
            ),
        )
        for r in rows
        if "failed" not in r
    ]
    memory = ("factor [MiB]", "3x3 factor [MiB]", "tangent [MiB]")
    return [
        "",
        "Single operations [ms]; solves have three right-hand sides (constant matrix) or "
        "one (3x3 tangent):",
        "",
        *table(("mesh, DoF", *names.values(), *memory), cells),
    ]


def explicit(stage: dict[str, Any]) -> list[str]:
    """Stable step, smoothness, time and memory."""
    s = stage["stable_step"]
    lines = [
        f"Largest stable explicit step {s['dt_s'] * 1e3:.3f} ms ({s['num_steps']} steps); "
        f"2 / largest angular frequency of the rest shape is {s['dt_linear_s'] * 1e3:.3f} ms.",
        "",
    ]
    cells = []
    for r in stage["landscapes"]:
        loss = r["loss"][0][len(r["alpha"]) // 2]
        row = [r["integrator"], f"{r['dt_s'] * 1e3:.3g}", number(r["energy_kept"]), number(loss)]
        for name in ("loss", "grad_norm"):
            m = r[f"{name}_smoothness"]
            row += [
                f"{number(100 * m['change_mean'])} ± {number(100 * m['change_std'])}",
                number(m["roughness"]),
                number(m["roughness_of_change"]),
            ]
        cells.append(row)
    header = (
        "integrator",
        "dt [ms]",
        "energy kept",
        "loss at x0",
        "loss change [%]",
        "roughness",
        "of change",
        "gradient change [%]",
        "roughness",
        "of change",
    )
    lines += table(header, cells)
    lines += [
        "",
        "Energy kept: mechanical energy at the end over that at the start, 1 for the exact motion. "
        "Change: relative change at the ends of all directions, mean ± standard deviation. "
        "Roughness: standard deviation of second differences of the relative change; of change: "
        "over that of first differences.",
        "",
    ]
    header = (
        "integrator",
        "steps",
        "checkpoints every",
        "forward [ms]",
        "backward [ms]",
        "saved for backward [MiB]",
        "peak memory [MiB]",
    )
    cells = [
        (
            r["integrator"],
            r["num_steps"],
            r["checkpoint_every"] or "–",
            number(r["forward_s"]["median"] * 1e3),
            number(r["backward_s"]["median"] * 1e3),
            f"{r['saved_B'] / 2**20:.2f}" if r["saved_B"] else "–",
            f"{r['memory_peak_B'] / 2**20:.2f}",
        )
        for r in stage["costs"]
        if "failed" not in r
    ]
    return lines + table(header, cells)


def accuracy(stage: dict[str, Any]) -> list[str]:
    """Solves per step and adjoint over the shares; the chosen share is bold."""
    lines = [
        "Solves with the constant factor, step + adjoint (newton_pcg), and iterations "
        "(quasi_newton), over the share of the volume or fiber term; the best of a row and those "
        "within 10 % of it are marked *, the share in use is bold. –: not converged.",
    ]
    for name in ("VOLUME_SHARE", "FIBER_SHARE"):
        rows = [r for r in stage["rows"] if r["name"] == name]
        if not rows:
            continue
        shares = sorted({r["share"] for r in rows})
        chosen = {r["share"] for r in rows if r["chosen"]}
        header = [f"{name}", *(f"**{s:g}**" if s in chosen else f"{s:g}" for s in shares)]
        groups: dict[str, Rows] = {}
        for r in rows:
            material = (
                f", nu {r['poissons_ratio']}, {r['volume_weight']}" if "poissons_ratio" in r else ""
            )
            groups.setdefault(f"{r['kind']}{material}, {r['method']}", []).append(r)
        cells = []
        for label, group in groups.items():
            cost = {
                r["share"]: r["step_solves"] + r["adjoint_solves"] for r in group if r["converged"]
            }
            best = min(cost.values(), default=0.0)
            cells.append(
                [
                    label,
                    *(
                        "–"
                        if s not in cost
                        else f"{cost[s]:.0f}{'*' if cost[s] <= 1.1 * best else ''}"
                        for s in shares
                    ),
                ]
            )
        lines += ["", *table(header, cells)]
    return lines
