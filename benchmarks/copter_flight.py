"""Flight steps per second against the batch: forward, and forward + backward.

A quadcopter under linear feedback about its trim, 100 control steps of 1 ms, one Runge-Kutta step
each; bare, and with drag, wind and motor lag. Steps per CPU second leave out what other programs
take from the machine; steps per wall second do not.

python benchmarks/copter_flight.py --threads 2
DIFFSIM_ISA=avx2 python benchmarks/copter_flight.py
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch

from benchmarks.harness import Seconds, cores, repeat_for, spread
from diffsim.copter import Multicopter
from diffsim.copter.dynamics.flight import Feedback, fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.effects import BodyDrag, FlightEffects, MotorLag, RotorDrag
from diffsim.core import interruptible
from diffsim.core.compiled import INSTRUCTION_SET

BATCHES = (1, 8, 64, 512, 4096)


def tensor(value: object) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def quadcopter() -> Multicopter:
    """Plus-shaped, 1.2 kg."""
    arm = 0.25
    return Multicopter(
        mass=tensor(1.2),
        inertia=torch.diag(tensor([0.02, 0.022, 0.04])),
        positions=tensor([[arm, 0, 0], [0, arm, 0], [-arm, 0, 0], [0, -arm, 0]]),
        directions=tensor([[0.0, 0.0, -1.0]] * 4),
        spins=tensor([1.0, -1.0, 1.0, -1.0]),
        torque_ratios=tensor([0.0147] * 4),
        max_thrusts=tensor([7.2] * 4),
        radii=tensor([0.127] * 4),
    )


def gain() -> torch.Tensor:
    """Proportional and derivative action on height, tilt and yaw; a benchmark needs no optimum."""
    K = torch.zeros(4, 12, dtype=torch.float64)
    K[:, 2], K[:, 8] = -2.0, -1.5
    for rotor, (roll, pitch, yaw) in enumerate([(0, 1, -1), (-1, 0, 1), (0, -1, -1), (1, 0, 1)]):
        K[rotor, 3:6] = tensor([10.0 * roll, 10.0 * pitch, 1.0 * yaw])
        K[rotor, 9:12] = tensor([2.0 * roll, 2.0 * pitch, 1.0 * yaw])
    return K


def effects(kind: str) -> FlightEffects:
    if kind == "bare":
        return FlightEffects()
    return FlightEffects(
        motor_lag=MotorLag(time_constants=tensor([0.05] * 4)),
        rotor_drag=RotorDrag(coefficient=tensor(0.02)),
        body_drag=BodyDrag(linear=tensor([0.1] * 3), quadratic=tensor([0.05] * 3)),
        wind=tensor([3.0, 0.0, 0.0]),
    )


def passes(batch: int, steps: int, kind: str, threads: int) -> dict[str, Callable[[], object]]:
    """Forward, forward of which the last state is kept, and with the gradient to commands, gain and
    mass."""
    vehicle, K, on = quadcopter(), gain(), effects(kind)
    start = FlightState.at_rest(0.1 * torch.randn(batch, 3, dtype=torch.float64))
    hover = (vehicle.weight / 4).expand(batch, steps, 4).contiguous()
    reference = torch.zeros(12, dtype=torch.float64)

    def forward(
        commands: torch.Tensor = hover,
        K: torch.Tensor = K,
        vehicle: Multicopter = vehicle,
        keep: str = "path",
    ) -> torch.Tensor:
        loop = Feedback(gain=K, reference=reference)
        flown = fly(
            vehicle,
            start,
            commands,
            dt=1e-3,
            feedback=loop,
            effects=on,
            keep=keep,
            num_threads=threads,
        )
        return flown.state.position

    def backward() -> object:
        leaves = [t.clone().requires_grad_() for t in (hover, K, vehicle.mass)]
        loss = forward(leaves[0], leaves[1], vehicle.replace(mass=leaves[2])).square().sum()
        return torch.autograd.grad(loss, leaves)

    return {
        "forward": forward,
        "forward, end alone": lambda: forward(keep="end"),
        "forward + backward": backward,
    }


def row(name: str, times: list[Seconds], vehicle_steps: int) -> str:
    wall, cpu = (spread([getattr(t, clock) for t in times]) for clock in ("wall", "cpu"))
    rates = (vehicle_steps / (s["median"] * 1e6) for s in (wall, cpu))
    return "{:28s} {:9.3f} M/s wall  {:9.3f} M/s CPU  ({:.0f} runs)".format(
        name, *rates, wall["count"]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0, help="per row")
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)  # the few torch operations around the kernel only spin with more
    print(f"{args.steps} steps, {INSTRUCTION_SET}, {args.threads} threads; vehicle-steps:")
    with cores(args.threads):
        for kind in ("bare", "drag, wind, lag"):
            for batch in args.batches:
                for name, call in passes(batch, args.steps, kind, args.threads).items():
                    times = repeat_for(call, seconds=args.seconds)
                    print(row(f"{kind} {batch:5d} {name}", times, batch * args.steps), flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
