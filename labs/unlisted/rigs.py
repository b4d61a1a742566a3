"""Machines by name: equations, data sheet, sensors; their sizes are drawn anew for every case."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from labs.unlisted.machine import Dial, Drive, Machine, Sheet

SPREAD = 0.3  # of a drawn machine's numbers about those below, in logarithms
DEG, MM = 180.0 / np.pi, 1e3


def _sheet(**numbers: tuple[float, str, float]) -> dict[str, Sheet]:
    return {name: Sheet(*said) for name, said in numbers.items()}


def _place(name: str, position: str, velocity: str, inertia: str, turns: bool) -> dict[str, str]:
    units = {"unit": "N m", "position_unit": "rad"} if turns else {"unit": "N"}
    return {"name": name, "position": position, "velocity": velocity, "inertia": inertia, **units}


SHAFT = Machine(
    "shaft",
    {"angle": 0.0, "rate": 0.0},
    _sheet(
        inertia=(4e-3, "kg m^2", 8.0),
        damping=(1.2e-2, "N m s/rad", 20.0),
        torque_constant=(0.1, "N m/A", 4.0),
    ),
    {"current": Drive("A", 0.0, 1.2)},
    {"encoder": Dial("angle", "deg", DEG, 0.03)},
    lambda n: {
        "angle": n["rate"],
        "rate": (n["torque_constant"] * n["current"] - n["damping"] * n["rate"] + n["push_shaft"])
        / n["inertia"],
    },
    lambda n: {"encoder": n["angle"]},
    {"angle": "rate", "rate": "(torque_constant*current - damping*rate)/inertia"},
    0.01,
    700,
    0.6,
    (_place("shaft", "angle", "rate", "inertia", turns=True),),
)

PENDULUM = Machine(
    "pendulum",
    {"angle": 0.0, "rate": 0.0},
    _sheet(
        inertia=(0.07, "kg m^2", 8.0),
        damping=(0.2, "N m s/rad", 20.0),
        weight=(1.96, "N m", 5.0),
        torque_constant=(0.5, "N m/A", 4.0),
    ),
    {"current": Drive("A", 0.0, 1.6)},
    {"encoder": Dial("angle", "deg", DEG, 0.0045)},
    lambda n: {
        "angle": n["rate"],
        "rate": (
            n["torque_constant"] * n["current"]
            - n["damping"] * n["rate"]
            - n["weight"] * np.sin(n["angle"])
            + n["push_hinge"]
        )
        / n["inertia"],
    },
    lambda n: {"encoder": n["angle"]},
    {
        "angle": "rate",
        "rate": "(torque_constant*current - damping*rate - weight*sin(angle))/inertia",
    },
    0.015,
    700,
    0.6,
    (_place("hinge", "angle", "rate", "inertia", turns=True),),
)

VANE = Machine(
    "vane",
    {"angle": 0.0, "rate": 0.0},
    _sheet(
        inertia=(0.5, "kg m^2", 8.0),
        damping=(0.9, "N m s/rad", 15.0),
        stiffness=(1.6, "N m/rad", 8.0),
    ),
    {"moment": Drive("N m", 0.0, 3.0)},
    {"bearing": Dial("angle", "deg", DEG, 0.012)},
    lambda n: {
        "angle": n["rate"],
        "rate": (
            n["moment"] - n["damping"] * n["rate"] - n["stiffness"] * n["angle"] + n["push_mast"]
        )
        / n["inertia"],
    },
    lambda n: {"bearing": n["angle"]},
    {"angle": "rate", "rate": "(moment - damping*rate - stiffness*angle)/inertia"},
    0.04,
    600,
    0.25,
    (_place("mast", "angle", "rate", "inertia", turns=True),),
)

CART = Machine(
    "cart",
    {"x": 0.0, "v": 0.0},
    _sheet(
        mass=(1.2, "kg", 5.0),
        damping=(3.0, "N s/m", 20.0),
        stiffness=(40.0, "N/m", 10.0),
    ),
    {"force": Drive("N", 0.0, 3.0)},
    {"position": Dial("x", "mm", MM, 0.0012)},
    lambda n: {
        "x": n["v"],
        "v": (n["force"] - n["damping"] * n["v"] - n["stiffness"] * n["x"] + n["push_cart"])
        / n["mass"],
    },
    lambda n: {"position": n["x"]},
    {"x": "v", "v": "(force - damping*v - stiffness*x)/mass"},
    0.02,
    600,
    0.7,
    (_place("cart", "x", "v", "mass", turns=False),),
)

TACHO_CART = replace(
    CART,
    name="tacho_cart",
    dials={**CART.dials, "speed": Dial("v", "m/s", 1.0, 0.012)},
    shows=lambda n: {"position": n["x"], "speed": n["v"]},
)

SLIDER = replace(
    CART,
    name="slider",
    numbers={**CART.numbers, "friction": Sheet(0.5, "N", 20.0)},
    rates=lambda n: {
        "x": n["v"],
        "v": (
            n["force"]
            - n["damping"] * n["v"]
            - n["friction"] * np.tanh(n["v"] / 0.01)
            - n["stiffness"] * n["x"]
            + n["push_cart"]
        )
        / n["mass"],
    },
    texts={"x": "v", "v": "(force - damping*v - friction*tanh(v/0.01) - stiffness*x)/mass"},
)

PRESS = replace(
    CART,
    name="press",
    dials={**CART.dials, "load": Dial("stiffness*x", "N", 1.0, 0.03)},
    shows=lambda n: {"position": n["x"], "load": n["stiffness"] * n["x"]},
)

MASSES = Machine(
    "masses",
    {"x": 0.0, "v": 0.0, "z": 0.0, "w": 0.0},
    _sheet(
        mass=(1.0, "kg", 4.0),
        load=(0.6, "kg", 4.0),
        stiffness=(35.0, "N/m", 8.0),
        coupling=(90.0, "N/m", 8.0),
        damping=(2.0, "N s/m", 20.0),
        loss=(0.8, "N s/m", 20.0),
    ),
    {"force": Drive("N", 0.0, 3.0)},
    {"drive": Dial("x", "mm", MM, 0.0012), "end": Dial("z", "mm", MM, 0.0012)},
    lambda n: {
        "x": n["v"],
        "v": (
            n["force"]
            - n["stiffness"] * n["x"]
            - n["damping"] * n["v"]
            + n["coupling"] * (n["z"] - n["x"])
            + n["loss"] * (n["w"] - n["v"])
            + n["push_motor"]
        )
        / n["mass"],
        "z": n["w"],
        "w": (n["coupling"] * (n["x"] - n["z"]) + n["loss"] * (n["v"] - n["w"]) + n["push_tool"])
        / n["load"],
    },
    lambda n: {"drive": n["x"], "end": n["z"]},
    {"x": "v", "v": "(force - stiffness*x - damping*v + pull)/mass", "z": "w", "w": "-pull/load"},
    0.02,
    600,
    0.7,
    (
        _place("motor", "x", "v", "mass", turns=False),
        _place("tool", "z", "w", "load", turns=False),
    ),
    {"define": {"pull": "coupling*(z - x) + loss*(w - v)"}},
)

TABLE = Machine(
    "table",
    {"x": 0.0, "v": 0.0, "y": 0.0, "w": 0.0},
    _sheet(
        mass=(2.0, "kg", 4.0),
        damping_x=(5.0, "N s/m", 20.0),
        damping_y=(6.0, "N s/m", 20.0),
        stiffness_x=(60.0, "N/m", 8.0),
        stiffness_y=(45.0, "N/m", 8.0),
    ),
    {"drive_x": Drive("N", 0.0, 4.0), "drive_y": Drive("N", 0.0, 4.0)},
    {"read_x": Dial("x", "mm", MM, 0.0012), "read_y": Dial("y", "mm", MM, 0.0012)},
    lambda n: {
        "x": n["v"],
        "v": (n["drive_x"] - n["damping_x"] * n["v"] - n["stiffness_x"] * n["x"] + n["push_east"])
        / n["mass"],
        "y": n["w"],
        "w": (n["drive_y"] - n["damping_y"] * n["w"] - n["stiffness_y"] * n["y"] + n["push_north"])
        / n["mass"],
    },
    lambda n: {"read_x": n["x"], "read_y": n["y"]},
    {
        "x": "v",
        "v": "(drive_x - damping_x*v - stiffness_x*x)/mass",
        "y": "w",
        "w": "(drive_y - damping_y*w - stiffness_y*y)/mass",
    },
    0.02,
    500,
    0.6,
    (
        _place("east", "x", "v", "mass", turns=False),
        _place("north", "y", "w", "mass", turns=False),
    ),
)

STAND = Machine(
    "stand",
    {"h": 0.22, "v": 0.0},
    _sheet(
        mass=(0.8, "kg", 4.0),
        damping=(1.6, "N s/m", 20.0),
        stiffness=(30.0, "N/m", 8.0),
        thrust_gain=(1.0, "", 4.0),
        rest=(0.22, "m", 0.0),
        carried=(6.0, "N", 0.0),
    ),
    {"thrust": Drive("N", 6.0, 2.0)},
    {"height": Dial("h", "mm", MM, 0.0012)},
    lambda n: {
        "h": n["v"],
        "v": (
            n["thrust_gain"] * n["thrust"]
            - n["carried"]
            - n["damping"] * n["v"]
            - n["stiffness"] * (n["h"] - n["rest"])
            + n["push_rotor"]
        )
        / n["mass"],
    },
    lambda n: {"height": n["h"]},
    {
        "h": "v",
        "v": "(thrust_gain*thrust - carried - damping*v - stiffness*(h - rest))/mass",
    },
    0.02,
    600,
    0.7,
    (_place("rotor", "h", "v", "mass", turns=False),),
)

HULL = Machine(
    "hull",
    {"x": 0.0, "v": 0.0},
    _sheet(
        mass=(12.0, "kg", 5.0),
        drag=(2.5, "N s^2/m^2", 10.0),
        thrust_gain=(1.0, "", 4.0),
    ),
    {"thrust": Drive("N", 22.0, 14.0)},
    {"log": Dial("v", "m/s", 1.0, 0.03)},
    lambda n: {
        "x": n["v"],
        "v": (n["thrust_gain"] * n["thrust"] - n["drag"] * n["v"] * np.abs(n["v"]) + n["push_hull"])
        / n["mass"],
    },
    lambda n: {"log": n["v"]},
    {"x": "v", "v": "(thrust_gain*thrust - drag*v*abs(v))/mass"},
    0.1,
    500,
    0.12,
    (_place("hull", "x", "v", "mass", turns=False),),
)

CAR = Machine(
    "car",
    {"x": 0.0, "v": 0.0},
    _sheet(
        mass=(90.0, "kg", 4.0),
        rolling=(28.0, "N", 12.0),
        drag=(3.0, "N s/m", 15.0),
        drive_gain=(1.0, "", 3.0),
    ),
    {"pull": Drive("N", 55.0, 20.0)},
    {"speed": Dial("v", "km/h", 3.6, 0.03)},
    lambda n: {
        "x": n["v"],
        "v": (
            n["drive_gain"] * n["pull"]
            - n["rolling"] * np.tanh(n["v"] / 0.1)
            - n["drag"] * n["v"]
            + n["push_car"]
        )
        / n["mass"],
    },
    lambda n: {"speed": n["v"]},
    {"x": "v", "v": "(drive_gain*pull - rolling*tanh(v/0.1) - drag*v)/mass"},
    0.4,
    500,
    0.03,
    (_place("car", "x", "v", "mass", turns=False),),
)

COIL = Machine(
    "coil",
    {"i": 0.0},
    _sheet(resistance=(3.0, "ohm", 4.0), inductance=(0.6, "H", 8.0)),
    {"voltage": Drive("V", 4.0, 8.0)},
    {"current": Dial("i", "A", 1.0, 0.03)},
    lambda n: {"i": (n["voltage"] - n["resistance"] * n["i"]) / n["inductance"]},
    lambda n: {"current": n["i"]},
    {"i": "(voltage - resistance*i)/inductance"},
    0.1,
    700,
    0.2,
)

MOTOR = Machine(
    "motor",
    {"i": 0.0, "rate": 0.0},
    _sheet(
        resistance=(1.5, "ohm", 4.0),
        inductance=(0.1, "H", 8.0),
        torque_constant=(0.12, "N m/A", 4.0),
        inertia=(3e-3, "kg m^2", 8.0),
        damping=(6e-3, "N m s/rad", 15.0),
    ),
    {"voltage": Drive("V", 0.0, 10.0)},
    {"ammeter": Dial("i", "A", 1.0, 0.06), "tacho": Dial("rate", "rad/s", 1.0, 0.6)},
    lambda n: {
        "i": (n["voltage"] - n["resistance"] * n["i"] - n["torque_constant"] * n["rate"])
        / n["inductance"],
        "rate": (n["torque_constant"] * n["i"] - n["damping"] * n["rate"]) / n["inertia"],
    },
    lambda n: {"ammeter": n["i"], "tacho": n["rate"]},
    {
        "i": "(voltage - resistance*i - torque_constant*rate)/inductance",
        "rate": "(torque_constant*i - damping*rate)/inertia",
    },
    0.05,
    600,
    0.4,
)


def _tank(outflow: str, sheet: tuple[float, str, float], start: float, name: str) -> Machine:
    """One tank; its outlet is a hole or a long pipe."""
    is_hole = outflow == "hole"

    def out(n: Mapping[str, float]) -> float:
        level = np.maximum(n["h"], 0.0)
        return n[outflow] * (np.sqrt(level) if is_hole else level)

    law = f"{outflow}*sqrt(max(h, 0))" if is_hole else f"{outflow}*max(h, 0)"
    return Machine(
        name,
        {"h": start},
        _sheet(**{outflow: sheet, "pump_gain": (0.02, "m/s", 6.0)}),
        {"pump": Drive("", 0.5, 0.45)},
        {"level": Dial("h", "mm", MM, 0.006)},
        lambda n: {"h": n["pump_gain"] * n["pump"] - out(n)},
        lambda n: {"level": n["h"]},
        {"h": f"pump_gain*pump - {law}"},
        1.0,
        600,
        0.012,
        more={"stores": [{"name": "tank", "level": "h", "unit": "m"}]},
    )


TANK = _tank("hole", (0.02, "m^0.5/s", 10.0), 0.25, "tank")
PIPE_TANK = _tank("conductance", (0.03, "1/s", 10.0), 0.3, "pipe_tank")

TANKS = Machine(
    "tanks",
    {"upper": 0.25, "lower": 0.25},
    _sheet(
        upper_hole=(0.02, "m^0.5/s", 10.0),
        lower_hole=(0.02, "m^0.5/s", 10.0),
        pump_gain=(0.02, "m/s", 6.0),
    ),
    {"pump": Drive("", 0.5, 0.45)},
    {"upper_level": Dial("upper", "mm", MM, 0.006), "lower_level": Dial("lower", "mm", MM, 0.006)},
    lambda n: {
        "upper": n["pump_gain"] * n["pump"] - n["upper_hole"] * np.sqrt(np.maximum(n["upper"], 0)),
        "lower": n["upper_hole"] * np.sqrt(np.maximum(n["upper"], 0))
        - n["lower_hole"] * np.sqrt(np.maximum(n["lower"], 0)),
    },
    lambda n: {"upper_level": n["upper"], "lower_level": n["lower"]},
    {"upper": "pump_gain*pump - between", "lower": "between - away"},
    1.0,
    600,
    0.01,
    more={
        "define": {
            "between": "upper_hole*sqrt(max(upper, 0))",
            "away": "lower_hole*sqrt(max(lower, 0))",
        },
        "stores": [
            {"name": "upper_tank", "level": "upper", "into": "lower_tank", "unit": "m"},
            {"name": "lower_tank", "level": "lower", "unit": "m"},
        ],
    },
)

VESSEL = Machine(
    "vessel",
    {"p": 2e4},
    _sheet(
        capacity=(2e-8, "m^3/Pa", 6.0),
        conductance=(5e-9, "m^3/(s Pa)", 10.0),
        supply_gain=(2e-4, "m^3/s", 5.0),
    ),
    {"supply": Drive("", 0.5, 0.45)},
    {"gauge": Dial("p", "mbar", 1e-2, 360)},
    lambda n: {
        "p": (n["supply_gain"] * n["supply"] - n["conductance"] * n["p"]) / n["capacity"],
    },
    lambda n: {"gauge": n["p"]},
    {"p": "(supply_gain*supply - conductance*p)/capacity"},
    0.2,
    600,
    0.06,
    more={"stores": [{"name": "vessel", "level": "p", "area": "capacity", "unit": "Pa"}]},
)

PLATE = Machine(
    "plate",
    {"warm": 20.0},
    _sheet(
        capacity=(400.0, "J/K", 5.0),
        loss=(1.2, "W/K", 10.0),
        heater_gain=(1.0, "", 3.0),
        room=(20.0, "K", 0.0),
    ),
    {"heater": Drive("W", 90.0, 85.0)},
    {"plate_temperature": Dial("warm", "K", 1.0, 0.3)},
    lambda n: {
        "warm": (n["heater_gain"] * n["heater"] - n["loss"] * (n["warm"] - n["room"]))
        / n["capacity"],
    },
    lambda n: {"plate_temperature": n["warm"]},
    {"warm": "(heater_gain*heater - loss*(warm - room))/capacity"},
    5.0,
    600,
    0.0025,
)

MACHINES: Mapping[str, Machine] = {
    m.name: m
    for m in (
        SHAFT, PENDULUM, VANE, CART, TACHO_CART, SLIDER, PRESS, MASSES, TABLE, STAND, HULL, CAR,
        COIL, MOTOR, TANK, PIPE_TANK, TANKS, VESSEL, PLATE,
    )
}  # fmt: skip


def drawn_machine(rng: np.random.Generator, name: str) -> Machine:
    """A machine with numbers of its own; sizes that starts depend on stay.

    Args:
        rng: Source of the numbers.
        name: Of ``MACHINES``.
    """
    machine = MACHINES[name]
    vary: Callable[[float], float] = partial(_varied, rng)
    numbers = {
        n: replace(s, value=vary(s.value)) if s.percent else s for n, s in machine.numbers.items()
    }
    return replace(machine, numbers=numbers, pace=vary(machine.pace))


def _varied(rng: np.random.Generator, value: float) -> float:
    return float(f"{value * np.exp(SPREAD * rng.uniform(-1.0, 1.0)):.3g}")


def drawn_numbers(rng: np.random.Generator, machine: Machine) -> dict[str, float]:
    """True numbers of a machine, within one and a half standard deviations of its sheet."""
    return {
        name: s.value * float(np.exp(0.01 * s.percent * np.clip(rng.standard_normal(), -1.5, 1.5)))
        for name, s in machine.numbers.items()
    }
