"""Causes that a library lists, made by the same machines: their names must stay."""

from __future__ import annotations

import numpy as np

from labs.unlisted.machine import Law, Machine, Now

Rng = np.random.Generator


def dry_friction(rng: Rng, machine: Machine) -> Law:
    """Friction that does not depend on the speed."""
    place = machine.places[0]
    push, speed = f"push_{place['name']}", place["velocity"]
    fades = 2e-3 * machine.reach(speed)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * np.tanh(now[speed] / fades)

    return Law((), (), (), 0.02, acts=acts, alike=("dry_friction",))


def lag(rng: Rng, machine: Machine) -> Law:
    """The drive lags; ``size`` is its time."""
    (drive,) = machine.drives

    def acts(now: Now, size: float) -> None:
        now["asked"], now[drive] = now[drive], now["late"]

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"late": (now["asked"] - now["late"]) / size}

    start = machine.drives[drive].middle
    return Law((), (), (), 0.05, acts=acts, moves=moves, hidden={"late": start}, most=0.5,
               alike=("lag",))  # fmt: skip


def sensor_scale(rng: Rng, machine: Machine) -> Law:
    """A tachometer shows too much."""

    def reads(now: Now, shown: Now, size: float) -> None:
        shown["speed"] = shown["speed"] * (1.0 + size)

    return Law((), (), (), 0.02, reads=reads, alike=("sensor_scale",), most=0.3)


def cubic_spring(rng: Rng, machine: Machine) -> Law:
    """A spring that stiffens."""
    place = machine.places[0]
    push, x = f"push_{place['name']}", place["position"]

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * now[x] ** 3

    return Law((), (), (), 100.0, acts=acts, alike=("cubic_stiffness",))
