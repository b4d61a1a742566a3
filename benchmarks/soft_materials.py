"""Hyperelastic materials: forward and backward by `auto`, a direct solver and two others, paired.

From the repository's root, on a machine that does nothing else:

python -m benchmarks.soft_materials               all materials and meshes, about ten minutes
python -m benchmarks.soft_materials --quick       small meshes, one tolerance, under a minute
python -m benchmarks.soft_materials --resume      go on after an interruption

The question of thesis fig. 4-19: with a neo-Hookean solid of 44,337 DoF, is a backward pass by
conjugate gradients on the constant factor, or by whatever `auto` takes, faster than the direct
solve that the thesis fell back to? The scene is the beam of ``benchmarks.soft``, twisted by 90
degrees and let go. In every repetition the methods follow each other in turn, so that a disturbance
meets all of them. Reported are CPU seconds of the one thread used (on a shared machine the clock on
the wall measures the neighbors), medians, and, per method, the median of its ratios to
`newton_cholesky` within repetitions. Written to ``--out``: report.md, results.json, parts/.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.harness import Benchmark, Part, cores, spread
from benchmarks.soft_scenes import Pass, cantilever, one_pass
from diffsim import soft
from diffsim.core import interruptible

METHODS = ("auto", "newton_cholesky", "newton_pcg", "quasi_newton")
BASELINE = "newton_cholesky"
# A quasi-Newton or PCG pass that takes this much longer than the baseline's is not repeated.
GIVE_UP = 4.0


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    # materials, kinds, rtols: every combination of them
    materials: tuple[str, ...] = soft.MATERIALS
    kinds: tuple[str, ...] = ("hex", "tet")
    rtols: tuple[float, ...] = (1e-4, 1e-6)
    # cells across the beam; 4 times as many along it. 15 has 46,848 DoF.
    widths: tuple[int, ...] = (4, 8, 15)
    # the only materials of meshes wider than ``all_up_to``
    large_materials: tuple[str, ...] = ("neo_hookean",)
    all_up_to: int = 8  # see large_materials
    num_steps: int = 3  # steps of 10 ms of one pass
    repetitions: int = 3  # passes per method
    poissons_ratio: float = 0.45  # [-]


QUICK = Plan(widths=(3,), rtols=(1e-4,), num_steps=2, repetitions=2)


def parts(plan: Plan) -> list[Part]:
    """One part per mesh, material and tolerance."""
    found = []
    for width in plan.widths:
        for kind in plan.kinds:
            for material in plan.materials:
                if width > plan.all_up_to and material not in plan.large_materials:
                    continue
                for rtol in plan.rtols:
                    settings = {
                        "width": width,
                        "kind": kind,
                        "material": material,
                        "rtol": rtol,
                        "num_steps": plan.num_steps,
                        "repetitions": plan.repetitions,
                        "poissons_ratio": plan.poissons_ratio,
                    }
                    name = f"materials/{kind}, {width} wide, {material}, {rtol:g}"
                    found.append(Part(name, settings, _compute(settings)))
    return found


def _compute(settings: dict[str, Any]) -> Callable[[dict[str, Any], Callable[[str], None]], Any]:
    def compute(_results: dict[str, Any], say: Callable[[str], None]) -> dict[str, Any]:
        with cores(1):
            return compare(settings, say)

    return compute


def compare(settings: dict[str, Any], say: Callable[[str], None] = lambda text: None) -> Any:
    """Passes of all methods in turn; one row per method."""
    width = settings["width"]
    bodies = {
        method: cantilever(
            settings["kind"],
            (4 * width, width, width),
            material=settings["material"],
            poissons_ratio=settings["poissons_ratio"],
            volume_weight="small_strain",
            solver=soft.SolverOptions(method=method, rtol=settings["rtol"], on_failure="warn"),
        )
        for method in METHODS
    }
    runs: dict[str, list[Pass]] = {method: [] for method in METHODS}
    dropped: set[str] = set()
    for method, body in bodies.items():  # analysis and factors: once per body, not counted
        say(f"{method}, first")
        one_pass(body, 1, degrees=10.0)
    for repetition in range(settings["repetitions"]):
        for method, body in bodies.items():
            if method in dropped:
                continue
            say(f"{method}, {repetition + 1}")
            runs[method].append(one_pass(body, settings["num_steps"]))
        dropped |= {m for m in METHODS if _cpu(runs[m][-1]) > GIVE_UP * _cpu(runs[BASELINE][-1])}
    reference = runs[BASELINE][0]
    steps = settings["num_steps"]
    rows = []
    for method, passes in runs.items():
        pairs = list(zip(passes, runs[BASELINE], strict=False))
        rows.append(
            {
                "method": method,
                "forward_s": spread([p.forward.cpu / steps for p in passes]),
                "backward_s": spread([p.backward.cpu / steps for p in passes]),
                "forward_ratio": spread([p.forward.cpu / b.forward.cpu for p, b in pairs]),
                "backward_ratio": spread([p.backward.cpu / b.backward.cpu for p, b in pairs]),
                "converged": all(p.converged for p in passes),
                "gradient_apart": float(
                    (passes[0].grad - reference.grad).norm() / reference.grad.norm()
                ),
                **passes[0].counts(),
            }
        )
    body = bodies["auto"]
    return {
        **settings,
        "num_dof": 3 * body.mesh.num_nodes,
        "num_elements": body.mesh.num_elements,
        "rows": rows,
    }


def _cpu(run: Pass) -> float:
    return run.forward.cpu + run.backward.cpu


def report(results: dict[str, Any], figures: Sequence[str] = ()) -> str:
    """Tables in Markdown."""
    about = ", ".join(f"{name}: {value}" for name, value in results["machine"].items())
    lines = [
        "# Hyperelastic materials",
        "",
        f"Machine: {about}.",
        "",
        "CPU seconds per step of one thread, median over the repetitions (count in brackets);",
        f"ratios are medians of pairs with `{BASELINE}` in the same repetition (below 1: faster",
        "than the direct solver).",
        "",
        "| mesh | DoF | material | rtol | method | forward s | ratio | backward s | ratio "
        "| Newton its | adjoint its | factors fwd, bwd | gradient apart |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for part in results["parts"]:
        for row in part["rows"]:
            mark = "" if row["converged"] else " (not converged)"
            lines.append(
                f"| {part['kind']} | {part['num_dof']} | {part['material']} | {part['rtol']:g} "
                f"| {row['method']}{mark} | {row['forward_s']['median']:.4f} "
                f"[{row['forward_s']['count']}] | {row['forward_ratio']['median']:.2f} "
                f"| {row['backward_s']['median']:.4f} | {row['backward_ratio']['median']:.2f} "
                f"| {row['step_iters']:.1f} | {row['adjoint_iters']:.0f} "
                f"| {row['step_factorizations']:.1f}, {row['adjoint_factorizations']:.1f} "
                f"| {row['gradient_apart']:.1e} |"
            )
    return "\n".join(lines) + "\n"


BENCHMARK = Benchmark(
    name="soft_materials",
    about=__doc__,
    stages={"passes": parts},
    collect=lambda results, plan: {"parts": list(results.values())},
    report=report,
    rooms=("soft", "contact", "mesh"),
)


def parse(argv: Sequence[str] | None = None) -> tuple[Plan, argparse.Namespace]:
    """The plan that command-line arguments ask for."""
    parser = BENCHMARK.parser(quick="small meshes, one tolerance")
    for name, kind in (("materials", str), ("kinds", str), ("rtols", float), ("widths", int)):
        parser.add_argument(f"--{name}", type=kind, nargs="+")
    parser.add_argument("--steps", dest="num_steps", type=int, help="steps of one pass")
    parser.add_argument("--repetitions", type=int, help="passes per method")
    args = parser.parse_args(argv)
    plan = asdict(QUICK if args.quick else Plan())
    for name in ("materials", "kinds", "rtols", "widths"):
        if getattr(args, name):
            plan[name] = tuple(getattr(args, name))
    if args.materials:
        plan["large_materials"] = tuple(args.materials)
    for name in ("num_steps", "repetitions"):
        if getattr(args, name):
            plan[name] = getattr(args, name)
    return Plan(**plan), args


def main(argv: Sequence[str] | None = None) -> int:
    return BENCHMARK.command(*parse(argv))


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
