"""Which nozzle lets the flow out exactly three times faster than it came in?

The amplifier of thesis fig. 4-20: slow flow, 64 x 48 cells, walls without friction. Two mirrored
Bezier curves with five free numbers bound the channel. Ten random channels are drawn, the best one
is improved by L-BFGS with the gradient of the flow with respect to its shape. The loss is the
average of |v - (3, 0)|^2 over the outlet, 1 for an average random channel, 0 for a perfect one;
that needs the right width, by conservation of mass a third of the inlet's, and a straight and even
flow at the end.

Expected: loss 4.8e-8 (thesis: 1.7e-5) after 25 evaluations, from 0.13 of the best random channel;
mean speed 3.000 at the outlet, 0.250 m wide; gradient equal to the finite difference to six
digits. Running time: 4 CPU seconds, 0.03 per flow with gradient (thesis: 0.2 s).

    python examples/stokes/amplifier.py --out runs/amplifier --export

writes pictures and numbers, the nozzle as a solid to print (.stl), its flow for ParaView (.vti) and
rerun (.rrd).
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse

import torch
from torch import Tensor

from diffsim.cli.device_design import run
from diffsim.stokes import devices


def gradient_error(device: devices.Device, x: Tensor, step: float = 1e-5) -> float:
    """Relative error of dL/dx against central differences, through shape, cells, flow and loss."""
    _, gradient = device.value_and_gradient(x)
    steps = step * torch.eye(len(x), dtype=torch.float64)
    slopes = [(device.value(x + s) - device.value(x - s)) / (2.0 * step) for s in steps]
    difference = torch.tensor(slopes, dtype=torch.float64) - gradient
    return float(difference.norm() / gradient.norm())


def main(
    resolution: float = 1.0,
    num_samples: int = 10,
    seed: int = 0,
    out: str | None = None,
    with_export: bool = False,
) -> dict[str, float]:
    """Design the nozzle; returns losses, speed and width of the outlet, error of the gradient."""
    torch.set_num_threads(1)
    device = devices.make("amplifier", resolution)
    optimum = run(device, out, num_samples=num_samples, seed=seed, with_export=with_export)
    flow = device.solve(optimum.x)
    return {
        "loss": optimum.loss,
        "first loss": float(optimum.evaluation_losses[0]),
        "outlet speed": float(devices.mean_velocity(flow, ["x+"])[0, 0]),
        "outlet width": float(devices.area(flow, ["x+"])),
        "error of the gradient": gradient_error(device, optimum.start),
        "mass imbalance": float(flow.mass_report()["imbalance"]),
    }


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument(
            "--small", action="store_true", help="half the resolution, four samples"
        )
        parser.add_argument("--seed", type=int, default=0, help="of the random channels")
        parser.add_argument("--out", metavar="FOLDER", help="picture, numbers and state; resumable")
        parser.add_argument("--export", action="store_true", help="write .stl, .vti, .rrd as well")
        args = parser.parse_args()
        if args.export and not args.out:
            parser.error("--export needs --out, the folder to write to")
        size = {"resolution": 0.5, "num_samples": 4} if args.small else {}
        results = main(seed=args.seed, out=args.out, with_export=args.export, **size)
        for name, value in results.items():
            print(f"{name:32s} {value:.6g}")
