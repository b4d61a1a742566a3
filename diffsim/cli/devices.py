"""``python -m diffsim.stokes.devices NAME``: design a device, write its numbers and picture."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from diffsim.core.files import write_json_atomic
from diffsim.stokes.devices import DEVICES, Device, Optimum, coarse_to_fine, make, optimize
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
) -> Optimum:
    """Optimise a device; print the numbers, write them and a picture.

    Args:
        device: The device.
        out: Folder for ``progress.json`` (an interrupted run goes on from it), ``result.json``,
            ``flow.png``, ``shapes.png``; None writes nothing.
        coarse: The same device on a coarser grid, on which designs are drawn and first improved.
        num_samples: Random designs; the thesis's number if None.
        seed: Of the samples.
        max_evaluations: Of loss and gradient.
        max_coarse_evaluations, num_starts, num_checked: Of ``coarse_to_fine``.
        with_export: Write the files of ``export`` into the folder, too.
        size: Longest side of the exported solid's box [m].
    """
    folder = None if out is None else Path(out)
    path = None if folder is None else folder / "progress.json"
    if coarse is None:
        optimum = optimize(device, num_samples, seed, max_evaluations=max_evaluations, path=path)
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
    """What a run found, for tables and files."""
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


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="diffsim.stokes.devices", description=__doc__)
    parser.add_argument("name", choices=list(DEVICES))
    parser.add_argument("--out", metavar="FOLDER", help="numbers, picture and state; resumable")
    parser.add_argument("--resolution", type=float, default=1.0, help="factor on cells per axis")
    parser.add_argument(
        "--sample-resolution",
        type=float,
        help="draw and first improve designs on this coarser grid (see coarse_to_fine)",
    )
    parser.add_argument(
        "--coarse-evaluations", type=int, default=50, help="on the coarser grid, at most, per start"
    )
    parser.add_argument("--starts", type=int, default=3, help="to improve on the coarser grid")
    parser.add_argument(
        "--checked", type=int, help="random designs on both grids, for the unit loss (8)"
    )
    parser.add_argument("--samples", type=int, help="random designs (the thesis's number)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=50, help="of loss and gradient, at most")
    parser.add_argument("--no-slip", action="store_true", help="walls of the twister")
    parser.add_argument(
        "--export",
        action="store_true",
        help="the optimised device as .stl, its flow as .vti, .rrd and streamlines (.png)",
    )
    parser.add_argument(
        "--size", type=float, default=0.1, help="longest side of the exported solid's box [m]"
    )
    given = parser.parse_args(arguments)
    if given.export and not given.out:
        parser.error("--export needs --out, the folder to write to")
    if given.no_slip and given.name != "twister":
        parser.error("--no-slip is for the twister; the other devices have the thesis's walls")
    torch.set_num_threads(1)
    options = {"wall": "no_slip"} if given.no_slip else {}
    device = make(given.name, given.resolution, **options)
    coarse = None
    if given.sample_resolution is not None:
        coarse = make(given.name, given.sample_resolution, **options)
    try:
        run(
            device,
            given.out,
            coarse=coarse,
            num_samples=given.samples,
            seed=given.seed,
            max_evaluations=given.evaluations,
            max_coarse_evaluations=given.coarse_evaluations,
            num_starts=given.starts,
            num_checked=given.checked,
            with_export=given.export,
            size=given.size,
        )
    except KeyboardInterrupt:
        again = ", the same command goes on" if given.out else ""
        print(f"interrupted{again}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
