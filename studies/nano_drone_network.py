"""``python -m studies.nano_drone_network``: a residual network, the rival of named causes.

The published model (thrust along the body's z axis, rates held) plus a network that adds specific
force and angular acceleration from velocity and rates in the body frame and the rotors' speeds. It
is trained through flights of half a second from recorded states, on the flights of use fit and by
the objective of ``benchmarks.ahead_fit``; the epoch that serves the flights of use select best is
kept, and scored by the benchmark's rule.
"""

from __future__ import annotations

import argparse
import time

import torch
from torch import Tensor, nn

from benchmarks.ahead import AHEAD, Predict, Record, errors_ahead, naive
from benchmarks.nano_drone import (
    DT,
    FIT,
    HEAD,
    MASS,
    PUBLISHED_GRAVITY,
    THRUST_CONSTANT,
    whole_flights,
)
from diffsim.core import interruptible
from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    quaternion_product,
)
from diffsim.data.study import Run

SELECT = ("square_4", "random1_2", "multisine_2")
HOVER = 1750.0  # [rad/s]
WIDTH, BATCH, EPOCHS, RATE, EVERY = 32, 128, 25, 4e-3, 12


class Residual(nn.Module):
    """Specific force [m/s^2] and angular acceleration [rad/s^2] that the published model lacks."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(10, WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh(), nn.Linear(WIDTH, 6)
        )
        self.scale = torch.tensor([1.0, 1.0, 1.0, 10.0, 10.0, 3.0])
        with torch.no_grad():  # at first it is the published model
            self.layers[-1].weight.mul_(0.01)
            self.layers[-1].bias.zero_()

    def forward(self, velocity: Tensor, rates: Tensor, speeds: Tensor) -> Tensor:
        """(num_starts, 6) from body velocity, body rates and speeds of the rotors."""
        seen = torch.cat([0.5 * velocity, 0.5 * rates, 4.0 * (speeds / HOVER - 1.0)], -1)
        return self.scale * self.layers(seen)


def fly(net: Residual, start: Record, speeds: Tensor) -> Record:
    """What follows each start under speeds (num_starts, AHEAD, 4)."""
    p, v, q, w = start.parts
    out = []
    down = torch.tensor([0.0, 0.0, PUBLISHED_GRAVITY], dtype=v.dtype)
    for k in range(speeds.shape[1]):
        n = speeds[:, k]
        turn = matrix_from_quaternion(q)
        more = net((turn * v[..., None]).sum(-2), w, n)
        force = more[:, :3] + torch.nn.functional.pad(
            (THRUST_CONSTANT * n**2).sum(-1, keepdim=True) / MASS, (2, 0)
        )
        a = (turn * force[:, None]).sum(-1) - down
        after = w + DT * more[:, 3:]
        p, v = p + DT * v + 0.5 * DT**2 * a, v + DT * a
        q = quaternion_product(q, quaternion_from_rotation_vector(0.5 * DT * (w + after)))
        w = after
        out.append((p, v, q, w))
    return Record(*(torch.stack(part, 1) for part in zip(*out, strict=True)))


class Flight:
    """A recorded flight in single precision."""

    def __init__(self, run: Run):
        self.truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float32))
        columns = [torch.as_tensor(run.command[f"n{i}"]) for i in (1, 2, 3, 4)]
        self.speeds = torch.stack(columns, -1).float()
        exact = Record(*(v.double() for v in self.truth.parts))
        self.held = errors_ahead(naive(exact), exact).mean(0).float()

    def predict(self, net: Residual) -> Predict:
        """The network's flights from starts."""

        def flown(starts: Tensor) -> Record:
            rows = starts[:, None] + torch.arange(1, AHEAD + 1)
            with torch.no_grad():
                return fly(net, self.truth.at(starts), self.speeds[rows])

        return flown

    def loss(self, net: Residual, starts: Tensor) -> Tensor:
        """Mean over the columns of the error over that of holding everything."""
        rows = starts[:, None] + torch.arange(1, AHEAD + 1)
        got, want = fly(net, self.truth.at(starts), self.speeds[rows]), self.truth.after(starts)
        sign = (got.quaternion * want.quaternion).sum(-1, keepdim=True).sign()
        off = (
            got.position - want.position,
            got.velocity - want.velocity,
            2.0 * (sign * got.quaternion - want.quaternion),
            got.rates - want.rates,
        )
        lengths = [(e.square().sum(-1) + 1e-8).sqrt().mean() for e in off]
        return (torch.stack(lengths) / self.held).mean()


def trained(fit: list[Flight], select: list[Flight], seed: int = 0) -> Residual:
    """The network at the epoch that serves the select flights best."""
    torch.manual_seed(seed)
    net, best, kept = Residual(), float("inf"), {}
    optimizer = torch.optim.Adam(net.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, EPOCHS)
    for epoch in range(EPOCHS):
        batches = [
            (flight, starts)
            for flight in fit
            for starts in (
                EVERY * torch.randperm((len(flight.speeds) - AHEAD - EVERY) // EVERY)
                + int(torch.randint(EVERY, ()))
            ).split(BATCH)
        ]
        for i in torch.randperm(len(batches)).tolist():
            optimizer.zero_grad()
            flight, starts = batches[i]
            flight.loss(net, starts).backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
        schedule.step()
        with torch.no_grad():
            ends = [f.loss(net, torch.arange(0, len(f.speeds) - AHEAD, 30)) for f in select]
        here = float(torch.stack(ends).mean())
        if here < best:
            best, kept = here, {k: v.clone() for k, v in net.state_dict().items()}
        print(f"epoch {epoch}: select {here:.4f}", flush=True)
    net.load_state_dict(kept)
    return net


def main() -> None:
    """Train, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", default="melon_a", help="flights, comma between them")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    begin = time.process_time()
    runs = {r.name: r for r in whole_flights((*FIT, *SELECT)).runs}
    net = trained([Flight(runs[n]) for n in FIT], [Flight(runs[n]) for n in SELECT], args.seed)
    print(f"{time.process_time() - begin:.0f} CPU s of training\n{HEAD}")
    for name in args.runs.split(","):
        flight = Flight(whole_flights((name,)).runs[0])
        exact = Record(*(v.double() for v in flight.truth.parts))
        row = errors_ahead(flight.predict(net), exact).sum(0).tolist()
        print(f"| network | {name} | " + " | ".join(f"{x:.3f}" for x in row) + " |", flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
