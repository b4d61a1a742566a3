"""``python -m diffsim.stokes.devices NAME``: design a device, write its numbers and picture."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from diffsim._files import write_json_atomic
from diffsim.stokes.devices import DEVICES, Device, Optimum, make, optimise
from diffsim.stokes.devices.picture import draw, numbers


def run(
    device: Device,
    out: str | Path | None,
    *,
    num_samples: int | None = None,
    seed: int = 0,
    max_evaluations: int = 50,
) -> Optimum:
    """Optimise a device; print the numbers, write them and a picture.

    Args:
        device: The device.
        out: Folder for ``progress.json`` (an interrupted run goes on from it), ``result.json``,
            ``flow.png``; None writes nothing.
        num_samples: Random designs; the thesis's number if None.
        seed: Of the samples.
        max_evaluations: Of loss and gradient.
    """
    folder = None if out is None else Path(out)
    optimum = optimise(
        device,
        num_samples,
        seed,
        max_evaluations=max_evaluations,
        path=None if folder is None else folder / "progress.json",
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
    return optimum


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="diffsim.stokes.devices", description=__doc__)
    parser.add_argument("name", choices=list(DEVICES))
    parser.add_argument("--out", metavar="FOLDER", help="numbers, picture and state; resumable")
    parser.add_argument("--resolution", type=float, default=1.0, help="factor on cells per axis")
    parser.add_argument("--samples", type=int, help="random designs (the thesis's number)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=50, help="of loss and gradient, at most")
    parser.add_argument("--no-slip", action="store_true", help="walls of the twister")
    given = parser.parse_args(arguments)
    if given.no_slip and given.name != "twister":
        parser.error("--no-slip is for the twister; the other devices have the thesis's walls")
    torch.set_num_threads(1)
    options = {"wall": "no_slip"} if given.no_slip else {}
    device = make(given.name, given.resolution, **options)
    try:
        run(
            device,
            given.out,
            num_samples=given.samples,
            seed=given.seed,
            max_evaluations=given.evaluations,
        )
    except KeyboardInterrupt:
        again = ", the same command goes on" if given.out else ""
        print(f"interrupted{again}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
