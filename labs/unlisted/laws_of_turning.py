"""Hidden laws of motors, gears and their encoders."""

from __future__ import annotations

import numpy as np

from labs.unlisted.machine import Law, Machine, Now, driven_place

Rng = np.random.Generator
ROTOR = (("angle",), ("encoder",), ("bearing",))


def cogging(rng: Rng, machine: Machine) -> Law:
    """Teeth of the stator hold the rotor."""
    push, entry = driven_place(machine)
    teeth = int(rng.choice([6, 7, 9, 12, 14] if machine.name == "shaft" else [9, 14, 20, 24]))
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] + size * np.sin(teeth * now["angle"] + phase)

    return Law(
        entry, ROTOR, ("periodic",), 1e-3, acts=acts,
        numbers=lambda size: {"amplitude": size, "wave_number": teeth},
    )  # fmt: skip


def unbalance(rng: Rng, machine: Machine) -> Law:
    """A bent axis: a weight off the center, once a turn."""
    push, entry = driven_place(machine)
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] + size * np.sin(now["angle"] + phase)

    return Law(
        entry, ROTOR, ("periodic",), 1e-3, acts=acts,
        numbers=lambda size: {"amplitude": size, "wave_number": 1.0},
    )  # fmt: skip


def commutation(rng: Rng, machine: Machine) -> Law:
    """The torque of a current is larger at some angles."""
    _, entry = driven_place(machine)
    waves = int(rng.choice([3, 4, 6]))
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def acts(now: Now, size: float) -> None:
        now["current"] = now["current"] * (1.0 + size * np.sin(waves * now["angle"] + phase))

    return Law(
        (("number", "torque_constant"), *entry),
        (*ROTOR, ("angle", "current"), ("encoder", "current")),
        ("periodic", "product"), 0.05, acts=acts, most=0.5,
        numbers=lambda size: {"share": size, "wave_number": waves},
    )  # fmt: skip


def encoder_ellipse(rng: Rng, machine: Machine) -> Law:
    """The encoder's disk sits off the center, or is an ellipse."""
    waves = int(rng.choice([1, 2]))
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def reads(now: Now, shown: Now, size: float) -> None:
        shown["encoder"] = shown["encoder"] + size * np.sin(waves * now["angle"] + phase)

    return Law(
        (("reading", "encoder"),), ROTOR, ("periodic",), 5e-3, reads=reads,
        numbers=lambda size: {"amplitude": size, "wave_number": waves},
    )  # fmt: skip


def gear_ripple(rng: Rng, machine: Machine) -> Law:
    """A gear between shaft and encoder runs out of round: it turns faster than the shaft."""
    ratio = float(rng.choice([3.0, 4.0, 5.0] if machine.name == "shaft" else [9.0, 12.0, 16.0]))
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def reads(now: Now, shown: Now, size: float) -> None:
        shown["encoder"] = shown["encoder"] + size * np.sin(ratio * now["angle"] + phase)

    return Law(
        (("reading", "encoder"),), ROTOR, ("periodic",), 5e-3, reads=reads,
        numbers=lambda size: {"amplitude": size, "wave_number": ratio},
    )  # fmt: skip


def iron(rng: Rng, machine: Machine) -> Law:
    """The iron saturates: torque falls behind the current; ``size`` is one over its current."""
    _, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now["current"] = np.tanh(size * now["current"]) / size

    return Law(
        (("number", "torque_constant"), *entry), (("current",),),
        ("saturation", "power", "product"), 0.3, acts=acts, most=1.5,
        numbers=lambda size: {"threshold": 1.0 / size}, alike=("saturation", "gain_slope"),
    )  # fmt: skip


def battery(rng: Rng, machine: Machine) -> Law:
    """An amplifier without a stage of its own gives more at a higher voltage."""
    (drive,) = machine.drives
    gain = "thrust_gain" if machine.name == "hull" else "torque_constant"
    _, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now[drive] = now[drive] * (now["battery"] / 12.0) ** size

    return Law(
        (("number", gain), *entry),
        (("battery",), ("battery", drive)), ("line", "power", "product"), 0.5, acts=acts, most=2.0,
        numbers=lambda size: {"exponent": size}, columns=("battery",),
    )  # fmt: skip


def wind_direction(rng: Rng, machine: Machine) -> Law:
    """Wind from one direction turns the vane."""
    push, entry = driven_place(machine)
    from_angle = rng.uniform(-0.6, 0.6)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] + size * now["wind"] * np.cos(now["angle"] - from_angle)

    return Law(
        entry, (("angle", "wind"), ("bearing", "wind"), ("wind",)),
        ("product", "periodic", "line"), 0.05, acts=acts, columns=("wind",),
        numbers=lambda size: {"amplitude": size, "wave_number": 1.0},
    )  # fmt: skip


def warm_winding(rng: Rng, machine: Machine) -> Law:
    """Resistance rises with the heat of the squared current."""
    time = rng.uniform(8.0, 20.0) if machine.name == "coil" else rng.uniform(5.0, 12.0)
    usual = 0.5 * machine.reach("i")

    def acts(now: Now, size: float) -> None:
        now["resistance"] = now["resistance"] * (1.0 + size * now["heat"])

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"heat": ((now["i"] / usual) ** 2 - now["heat"]) / time}

    return Law(
        (("number", "resistance"), ("rate", "i"), ("input", "voltage")),
        (("i",), ("current",), ("ammeter",)), ("memory", "line", "product"), 0.05,
        memory=("heat",), acts=acts, moves=moves, hidden={"heat": 0.0}, most=0.6,
        numbers=lambda size: {"time": time},
    )  # fmt: skip
