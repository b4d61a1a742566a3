"""Hidden laws of carts, springs, cables and vehicles."""

from __future__ import annotations

import numpy as np

from labs.unlisted.machine import Law, Machine, Now, driven_place

Rng = np.random.Generator
SPEED, STROKE = (("v",), ("speed",)), (("x",), ("position",), ("drive",))


def wire_rope(rng: Rng, machine: Machine) -> Law:
    """A rope that slips within itself: a spring that gives after a distance (Dahl)."""
    push, entry = driven_place(machine)
    slips = machine.reach("x") * rng.uniform(0.06, 0.15)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * now["slip"] / slips

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"slip": now["v"] - np.abs(now["v"]) * now["slip"] / slips}

    return Law(
        entry, (*SPEED, *STROKE, ("x", "v")), ("memory", "line", "saturation"), 0.1,
        memory=("slip",), acts=acts, moves=moves, hidden={"slip": 0.0},
        numbers=lambda size: {"amplitude": size, "threshold": slips},
    )  # fmt: skip


def bouc_wen(rng: Rng, machine: Machine) -> Law:
    """A loop with rounded corners that loads otherwise than it unloads (Bouc and Wen)."""
    push, entry = driven_place(machine)
    slips = machine.reach("x") * rng.uniform(0.08, 0.2)
    power, beta = rng.uniform(1.3, 2.5), rng.uniform(0.5, 0.9)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * now["slip"] / slips

    def moves(now: Now, rates: Now, size: float) -> Now:
        v, z = now["v"], now["slip"] / slips
        bend = beta * np.abs(v) * z * np.abs(z) ** (power - 1.0)
        return {"slip": v - bend - (1.0 - beta) * v * np.abs(z) ** power}

    return Law(
        entry, (*SPEED, *STROKE, ("x", "v")), ("memory", "line", "saturation"), 0.1,
        memory=("slip",), acts=acts, moves=moves, hidden={"slip": 0.0},
        numbers=lambda size: {"amplitude": size},
    )  # fmt: skip


def odd_relaxation(rng: Rng, machine: Machine) -> Law:
    """A spring in series with a damper whose force grows with the square of its speed."""
    push, entry = driven_place(machine)
    usual = machine.reach("x")
    time = rng.uniform(0.5, 1.5)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * now["stretch"]

    def moves(now: Now, rates: Now, size: float) -> Now:
        q = now["stretch"] / usual
        return {"stretch": now["v"] - usual / time * q / np.sqrt(np.abs(q) + 1e-3)}

    return Law(
        entry, (*SPEED, *STROKE), ("memory", "line", "power"), 5.0, memory=("relaxation",),
        acts=acts, moves=moves, hidden={"stretch": 0.0}, alike=("relaxing_spring",),
        numbers=lambda size: {"amplitude": size},
    )  # fmt: skip


def _hidden_mass(machine: Machine, hertz: float, damping: float) -> Law:
    push, entry = driven_place(machine)
    wave = 2.0 * np.pi * hertz

    def pull(now: Now, size: float) -> float:
        return size * (wave**2 * now["sway"] + 2.0 * damping * wave * now["sway_rate"])

    def acts(now: Now, size: float) -> None:
        now["mass"] = now["mass"] - size  # what swings was weighed with the rest
        now[push] = now[push] + pull(now, size)

    def moves(now: Now, rates: Now, size: float) -> Now:
        swing = -(wave**2) * now["sway"] - 2.0 * damping * wave * now["sway_rate"]
        return {"sway": now["sway_rate"], "sway_rate": swing - rates["v"]}

    return Law(
        entry, (*SPEED, *STROKE, ("force",), ("pull",), ("x", "v")), ("memory", "line"), 0.05,
        memory=("oscillator",), acts=acts, moves=moves, hidden={"sway": 0.0, "sway_rate": 0.0},
        most=0.5 * machine.numbers["mass"].value,
        numbers=lambda size: {"frequency": hertz},
    )  # fmt: skip


def slosh(rng: Rng, machine: Machine) -> Law:
    """A part of the load swings: a liquid, something on a string."""
    return _hidden_mass(machine, machine.pace * rng.uniform(1.2, 2.2), rng.uniform(0.02, 0.06))


def flexible_mode(rng: Rng, machine: Machine) -> Law:
    """A second mode of the structure, faster than the one of the model."""
    return _hidden_mass(machine, machine.pace * rng.uniform(2.2, 3.5), rng.uniform(0.01, 0.03))


def magnet(rng: Rng, machine: Machine) -> Law:
    """A magnet pulls from one end of the stroke."""
    push, entry = driven_place(machine)
    gap = machine.reach("x") * rng.uniform(1.8, 2.2)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] + size / np.maximum(gap - now["x"], 0.1 * gap) ** 2

    return Law(
        entry, STROKE, ("reciprocal", "power", "exponential"), 1e-4, acts=acts, most=8e-3,
        numbers=lambda size: {"exponent": -2.0},
    )  # fmt: skip


def wall(rng: Rng, machine: Machine) -> Law:
    """A wall nearby draws the propeller."""
    push, entry = driven_place(machine)
    low, high = machine.extents["h"]
    length = (high - low) * rng.uniform(0.15, 0.3)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * np.exp(-np.maximum(now["h"] - low, -0.5 * length) / length)

    return Law(
        entry, (("h",), ("height",)), ("exponential", "reciprocal", "power"), 5e-3, acts=acts,
        numbers=lambda size: {"rate": -1.0 / length}, most=0.6,
    )  # fmt: skip


def ground_cushion(rng: Rng, machine: Machine) -> Law:
    """Near the ground a rotor gives more thrust."""
    _, entry = driven_place(machine)
    low, radius = machine.extents["h"][0], rng.uniform(0.06, 0.1)

    def acts(now: Now, size: float) -> None:
        height = np.maximum(now["h"], 0.5 * low)
        now["thrust"] = now["thrust"] * (1.0 + size * (radius / height) ** 2)

    return Law(
        (("number", "thrust_gain"), *entry),
        (("h",), ("height",), ("h", "thrust"), ("height", "thrust")),
        ("reciprocal", "power", "exponential", "product"), 0.1, acts=acts, most=1.0,
        numbers=lambda size: {"exponent": -2.0}, alike=("ground_effect",),
    )  # fmt: skip


def cable(rng: Rng, machine: Machine) -> Law:
    """A cable comes taut beyond a place, and pulls back from there."""
    push, entry = driven_place(machine)
    taut = machine.extents["x"][1] * rng.uniform(0.3, 0.5)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * np.maximum(now["x"] - taut, 0.0)

    return Law(
        (*entry, ("number", "stiffness")), STROKE, ("threshold",), 10.0, acts=acts, most=200.0,
        numbers=lambda size: {"amplitude": size, "threshold": taut}, alike=("stop_above",),
    )  # fmt: skip


def unequal_spring(rng: Rng, machine: Machine) -> Law:
    """Stiffer in compression than in tension."""
    push, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] - size * np.minimum(now["x"], 0.0)

    return Law(
        (*entry, ("number", "stiffness")), STROKE, ("threshold",), 2.0, acts=acts, most=40.0,
        numbers=lambda size: {"threshold": 0.0, "amplitude": size},
    )  # fmt: skip


def screw(rng: Rng, machine: Machine) -> Law:
    """A screw that runs out of round: friction depends on the place, once a pitch."""
    _, entry = driven_place(machine)
    wave = 2.0 * np.pi / (machine.reach("x") * rng.uniform(0.4, 0.8))
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def acts(now: Now, size: float) -> None:
        now["damping"] = now["damping"] * (1.0 + size * np.sin(wave * now["x"] + phase))

    return Law(
        (("number", "damping"), *entry), (*STROKE, ("x", "v"), ("position", "v")),
        ("periodic", "product"), 0.2, acts=acts, most=0.9,
        numbers=lambda size: {"share": size, "wave_number": wave},
    )  # fmt: skip


def warm_damping(rng: Rng, machine: Machine) -> Law:
    """The oil of the damper gets thin as it warms; the recorder wrote its temperature."""
    _, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now["damping"] = now["damping"] * np.exp(-size * (now["temp"] - 25.0))

    return Law(
        (("number", "damping"), *entry), (("temp",), ("temp", "v"), ("temp", "rate")),
        ("exponential", "reciprocal", "power", "product"), 0.01, acts=acts, most=0.06,
        numbers=lambda size: {"rate": -size}, columns=("temp",), bend=lambda size: 5.0 * size,
    )  # fmt: skip


def warm_spring(rng: Rng, machine: Machine) -> Law:
    """A spring of plastic gets softer as it warms."""
    _, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now["stiffness"] = now["stiffness"] * (1.0 - size * (now["temp"] - 25.0))

    return Law(
        (("number", "stiffness"), *entry), (("temp",), ("temp", "x"), ("temp", "angle")),
        ("line", "exponential", "product"), 2e-3, acts=acts, most=0.02,
        numbers=lambda size: {"rate": -size}, columns=("temp",),
    )  # fmt: skip


def bellows(rng: Rng, machine: Machine) -> Law:
    """Air pressure acts on a bellows; the recorder wrote the weather."""
    push, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now[push] = now[push] + size * (now["ambient"] - 1013.0)

    return Law(
        entry, (("ambient",),), ("line",), 0.005, acts=acts, columns=("ambient",),
        numbers=lambda size: {"amplitude": size},
    )  # fmt: skip


def worn_spring(rng: Rng, machine: Machine) -> Law:
    """Stiffness falls with the work done; each run has a fresh spring."""
    _, entry = driven_place(machine)
    x = machine.reach("x")
    span = machine.step_s * machine.count
    usual = 2.0 * machine.numbers["stiffness"].value * x**2 * machine.pace * span

    def acts(now: Now, size: float) -> None:
        now["fresh"] = now["stiffness"]
        now["stiffness"] = now["stiffness"] * np.exp(-size * now["work"])

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"work": np.abs(now["fresh"] * now["x"] * now["v"]) / usual}

    return Law(
        (("number", "stiffness"), *entry), (*STROKE, *SPEED, ("x", "v"), ("force",)),
        ("memory", "exponential", "line", "product"), 0.1, memory=("work",), acts=acts,
        moves=moves, hidden={"work": 0.0}, most=1.0,
    )  # fmt: skip


def aging_friction(rng: Rng, machine: Machine) -> Law:
    """Friction grows while the slider is slow, and is lost within a time when it is fast."""
    _, entry = driven_place(machine)
    time, slow = rng.uniform(0.5, 1.5), 0.3 * machine.reach("v")

    def acts(now: Now, size: float) -> None:
        now["friction"] = now["friction"] * (1.0 + size * now["age"])

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"age": (np.exp(-((now["v"] / slow) ** 2)) - now["age"]) / time}

    return Law(
        (("number", "friction"), *entry), (*SPEED, ("x", "v")), ("memory", "line", "product"),
        0.3, memory=("relaxation", "heat"), acts=acts, moves=moves, hidden={"age": 0.0}, most=3.0,
        numbers=lambda size: {"time": time},
    )  # fmt: skip


def warm_tire(rng: Rng, machine: Machine) -> Law:
    """Tires roll easier as the work of rolling warms them."""
    _, entry = driven_place(machine)
    time, usual = rng.uniform(25.0, 60.0), machine.reach("v")

    def acts(now: Now, size: float) -> None:
        now["rolling"] = now["rolling"] * (1.0 - size * now["heat"])

    def moves(now: Now, rates: Now, size: float) -> Now:
        return {"heat": (np.abs(now["v"]) / usual - now["heat"]) / time}

    return Law(
        (("number", "rolling"), *entry), SPEED, ("memory", "line", "product"), 0.1,
        memory=("heat", "work", "relaxation"), acts=acts, moves=moves, hidden={"heat": 0.0},
        numbers=lambda size: {"time": time}, most=0.7,
    )  # fmt: skip


def head_wind(rng: Rng, machine: Machine) -> Law:
    """Drag of the hull's upper part against the wind that the mast recorded."""
    push, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        air = now["v"] + now["wind"]
        now[push] = now[push] - size * air * np.abs(air)

    return Law(
        (*entry, ("number", "drag")), (("v", "wind"), ("log", "wind"), ("wind",)),
        ("square", "product", "power"), 0.05, acts=acts, columns=("wind",),
        numbers=lambda size: {"amplitude": size},
    )  # fmt: skip


def advance(rng: Rng, machine: Machine) -> Law:
    """A propeller gives less thrust the faster the boat is."""
    _, entry = driven_place(machine)

    def acts(now: Now, size: float) -> None:
        now["thrust"] = now["thrust"] * (1.0 - size * now["v"])

    return Law(
        (("number", "thrust_gain"), *entry),
        (("v",), ("log",), ("v", "thrust"), ("log", "thrust")), ("line", "product"), 0.02,
        acts=acts, numbers=lambda size: {"rate": -size}, most=0.15,
    )  # fmt: skip
