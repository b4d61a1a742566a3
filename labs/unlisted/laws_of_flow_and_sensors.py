"""Hidden laws of tanks, plates and sensors."""

from __future__ import annotations

import numpy as np

from labs.unlisted.machine import Law, Machine, Now

Rng = np.random.Generator


def leak_above(rng: Rng, machine: Machine) -> Law:
    """A crack in the wall: it leaks above its level."""
    edge = machine.within("h", rng.uniform(0.4, 0.6))

    def acts(now: Now, size: float) -> None:
        now["pump"] = now["pump"] - size * np.maximum(now["h"] - edge, 0.0) / now["pump_gain"]

    outlet = "hole" if "hole" in machine.numbers else "conductance"
    return Law(
        (("rate", "h"), ("force", "tank"), ("input", "pump"), ("number", outlet)),
        (("h",), ("level",)),
        ("threshold",), 0.005, acts=acts, most=0.1, alike=("overflow",),
        numbers=lambda size: {"threshold": edge, "amplitude": size},
    )  # fmt: skip


def relief_valve(rng: Rng, machine: Machine) -> Law:
    """A valve opens above a pressure."""
    opens = machine.within("p", rng.uniform(0.4, 0.6))

    def acts(now: Now, size: float) -> None:
        flow = size * np.maximum(now["p"] - opens, 0.0)
        now["supply"] = now["supply"] - flow / now["supply_gain"]

    return Law(
        (("rate", "p"), ("force", "vessel"), ("input", "supply"), ("number", "conductance")),
        (("p",), ("gauge",)),
        ("threshold",), 5e-10, acts=acts, most=2e-8, alike=("overflow",),
        numbers=lambda size: {"threshold": opens},
    )  # fmt: skip


def floor_hole(rng: Rng, machine: Machine) -> Law:
    """A hole in the upper tank's floor: what it loses does not reach the lower one."""

    def acts(now: Now, size: float) -> None:
        lost = size * np.sqrt(np.maximum(now["upper"], 0.0))
        now["pump"] = now["pump"] - lost / now["pump_gain"]

    return Law(
        (("rate", "upper"), ("force", "upper_tank"), ("input", "pump")),
        (("upper",), ("upper_level",)), ("power", "line"), 5e-4, acts=acts, most=0.02,
        numbers=lambda size: {"amplitude": size},
        alike=("root_outflow_of_upper", "linear_leak_of_upper"),
    )  # fmt: skip


def thin_oil(rng: Rng, machine: Machine) -> Law:
    """What flows through the long pipe gets thin as it warms."""

    def acts(now: Now, size: float) -> None:
        now["conductance"] = now["conductance"] * np.exp(size * (now["temp"] - 25.0))

    return Law(
        (("number", "conductance"), ("rate", "h"), ("force", "tank")),
        (("temp",), ("temp", "h"), ("temp", "level")),
        ("exponential", "reciprocal", "power", "product"), 0.005, acts=acts, most=0.04,
        numbers=lambda size: {"rate": size}, columns=("temp",), bend=lambda size: 5.0 * size,
    )  # fmt: skip


def radiation(rng: Rng, machine: Machine) -> Law:
    """A black plate loses heat by radiation, too; ``size`` is the share of a black body."""
    per_black = 5.67e-8 * 0.05  # W/K^4 of 0.05 m^2

    def acts(now: Now, size: float) -> None:
        glow = per_black * ((now["warm"] + 273.15) ** 4 - 293.15**4)
        now["heater"] = now["heater"] - size * glow / now["heater_gain"]

    return Law(
        (("rate", "warm"), ("force", "plate"), ("input", "heater"), ("number", "loss")),
        (("warm",), ("plate_temperature",)), ("power", "square", "exponential"), 0.1,
        acts=acts, most=1.5,
    )  # fmt: skip


def fan(rng: Rng, machine: Machine) -> Law:
    """Draught cools the plate; the recorder wrote its speed."""

    def acts(now: Now, size: float) -> None:
        now["loss"] = now["loss"] * (1.0 + size * np.sqrt(now["wind"]))

    return Law(
        (("number", "loss"), ("rate", "warm"), ("input", "heater")), (("wind",), ("warm", "wind")),
        ("power", "product", "saturation"), 0.02, acts=acts, most=0.5,
        numbers=lambda size: {"exponent": 0.5}, columns=("wind",),
    )  # fmt: skip


def cross_talk(rng: Rng, machine: Machine) -> Law:
    """One amplifier hears the other: x shows a share of y."""

    def reads(now: Now, shown: Now, size: float) -> None:
        shown["read_x"] = shown["read_x"] + size * shown["read_y"]

    return Law(
        (("reading", "read_x"),), (("y",), ("read_y",)), ("line",), 0.01, reads=reads, most=0.3,
        numbers=lambda size: {"share": size},
    )  # fmt: skip


def rotated_sensor(rng: Rng, machine: Machine) -> Law:
    """The camera is turned by a small angle."""

    def reads(now: Now, shown: Now, size: float) -> None:
        x, y = shown["read_x"], shown["read_y"]
        shown["read_x"] = x * np.cos(size) + y * np.sin(size)
        shown["read_y"] = y * np.cos(size) - x * np.sin(size)

    return Law(
        (("reading", "read_x"), ("reading", "read_y")),
        (("y",), ("read_y",), ("x",), ("read_x",), ("x", "y"), ("read_x", "read_y")),
        ("line",), 0.01, reads=reads, numbers=lambda size: {"share": float(np.sin(size))},
        most=0.3, alike=("sensor_tilt",),
    )  # fmt: skip


def skewed_drives(rng: Rng, machine: Machine) -> Law:
    """The drives are turned against the axes: x feels a share of what pushes y."""

    def acts(now: Now, size: float) -> None:
        east, north = now["drive_x"], now["drive_y"]
        now["drive_x"], now["drive_y"] = east + size * north, north - size * east

    return Law(
        (("input", "drive_x"), ("input", "drive_y"), ("force", "east"), ("force", "north"),
         ("rate", "v"), ("rate", "w")),
        (("drive_y",), ("drive_x",)), ("line",), 0.01, acts=acts, most=0.3,
        numbers=lambda size: {"share": size},
    )  # fmt: skip


def creeping_cell(rng: Rng, machine: Machine) -> Law:
    """A load cell creeps: a share of its reading comes slowly."""
    time = rng.uniform(1.5, 4.0)

    def reads(now: Now, shown: Now, size: float) -> None:
        shown["load"] = shown["load"] + size * now["creep"]

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"creep": (now["stiffness"] * now["x"] - now["creep"]) / time}

    return Law(
        (("reading", "load"),), (("x",), ("load",), ("position",)), ("memory", "line"), 0.02,
        memory=("relaxation", "heat"), reads=reads, moves=moves, hidden={"creep": 0.0}, most=0.5,
        numbers=lambda size: {"share": size, "time": time},
    )  # fmt: skip
