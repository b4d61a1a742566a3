"""Design a fluidic device, print and keep its numbers, draw it: the body of ``diffsim devices``."""

from __future__ import annotations

from concurrent.futures import Executor
from pathlib import Path

from diffsim.core.files import write_json_atomic
from diffsim.stokes.devices import Device, Optimum, coarse_to_fine, optimize
from diffsim.viz.device_evolution import draw_shapes
from diffsim.viz.device_files import export
from diffsim.viz.device_picture import draw


def run(
    device: Device,
    out: str | Path | None,
    *,
    coarse: Device | None = None,
    num_samples: int | None = None,
    seed: int = 0,
    max_evaluations: int = 50,
    max_coarse_evaluations: int = 50,
    num_starts: int = 3,
    num_checked: int | None = None,
    with_export: bool = False,
    size: float = 0.1,
    executor: Executor | None = None,
) -> Optimum:
    """Optimize a device; print the numbers, write them and a picture.

    Args:
        device: Device to be optimized.
        out: Folder for ``progress.jsonl`` (an interrupted run goes on from it), ``result.json``,
            ``flow.png``, ``shapes.png``; None writes nothing.
        coarse: The same device on a coarser grid, on which designs are drawn and first improved.
        num_samples: Random designs; the thesis's number if None.
        seed: Seed of the random designs.
        max_evaluations: Largest number of evaluations of loss and gradient.
        max_coarse_evaluations, num_starts, num_checked: Options of ``coarse_to_fine`` of the same
            names.
        with_export: Write the files of ``export`` into the folder, too.
        size: Longest side of the exported solid's box [m].
        executor: Executor of random designs and coarse descents.
    """
    folder = None if out is None else Path(out)
    path = None if folder is None else folder / "progress.jsonl"
    if folder is not None and (folder / "progress.json").exists():
        print(f"{folder / 'progress.json'} is of an older version of diffsim; it is not used")
    if coarse is None:
        optimum = optimize(
            device,
            num_samples,
            seed,
            max_evaluations=max_evaluations,
            path=path,
            executor=executor,
        )
    else:
        optimum = coarse_to_fine(
            device,
            coarse,
            num_samples,
            seed,
            num_starts=num_starts,
            num_checked=num_checked,
            max_evaluations=max_evaluations,
            max_coarse_evaluations=max_coarse_evaluations,
            path=path,
            executor=executor,
        )
    for name, value in numbers(device, optimum).items():
        print(f"{name:32s} {value if isinstance(value, str) else format(value, '.4g')}")
    if folder is not None:
        names = [p.name for p in device.parameters]
        design = dict(zip(names, optimum.x.tolist(), strict=True))
        result = {
            "device": device.name,
            "options": dict(device.options),
            "seed": seed,
            **numbers(device, optimum),
            "design": design,
        }
        write_json_atomic(folder / "result.json", result)
        print(f"wrote {draw(device, optimum, folder / 'flow.png')}")
        print(f"wrote {draw_shapes(device, optimum, folder / 'shapes.png')}")
        for file in export(device, optimum.x, folder, size=size) if with_export else []:
            print(f"wrote {file}")
    return optimum


def numbers(device: Device, optimum: Optimum) -> dict[str, float | str]:
    """Results of a run, for tables and files."""
    out: dict[str, float | str] = {
        "loss": optimum.loss,
        "loss of best random design": float(optimum.sample_losses.min()),
        "loss in the thesis": device.reference.get("loss", float("nan")),
        "unit loss": optimum.unit_loss,
        "random designs": len(optimum.samples),
        "rejected random designs": optimum.num_rejected,
        "evaluations": len(optimum.evaluation_losses),
        "CPU seconds per loss and gradient": optimum.seconds,
        "wall seconds in the thesis": device.reference.get("seconds", float("nan")),
        "message": optimum.message,
    }
    if optimum.coarse is not None:
        coarse = optimum.coarse
        ends = [d.loss / coarse.unit_loss for d in coarse.descents]
        fine = coarse.fine_losses / optimum.unit_loss
        out |= {
            "unit loss, standard error": coarse.unit_error,
            "unit loss, designs on both grids": len(coarse.checked_fine),
            "unit loss on the coarse grid": coarse.unit_loss,
            "losses found on the coarse grid": ", ".join(f"{v:.3g}" for v in ends),
            "the same designs on this grid": ", ".join(f"{v:.3g}" for v in fine.tolist()),
            "evaluations on the coarse grid": sum(len(d.losses) for d in coarse.descents),
        }
    return out
