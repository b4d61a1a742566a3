"""Cosserat rods of PyElastica with one hidden cause, described by their first mode of bending."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run
from labs.outside.case import Case, Maker, off, plan, recorded

Array = NDArray[np.float64]
TIME: Array = 0.02 * np.arange(101.0)
LENGTH, RADIUS, DENSITY, ELEMENTS = 0.5, 0.01, 1100.0, 8
STEP = 1e-4


def bend(
    run: Run, modulus: float, loss: float, late_s: float = 0.0, drag: float = 0.0, stop: float = 1.0
) -> Array:
    """Height of the tip under a force at it, (num_samples, 1).

    Args:
        run: Run with the force.
        modulus: Young's modulus [Pa].
        loss: Damping constant of the material's motion [1/s].
        late_s: Time by which the force comes later [s].
        drag: Force over squared speed, per length [N s^2/m^3].
        stop: Height at which the tip meets a stiff stop [m].
    """
    import elastica as ea

    class System(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        """One rod, clamped at its foot."""

    class Loads(ea.NoForces):
        """What acts on the nodes."""

        def apply_forces(self, system: Any, time: float = 0.0) -> None:
            heard = np.interp(time - late_s, run.time_s, run.command["force"])
            height = system.position_collection[2]
            heard -= 2e3 * max(height[-1] - stop, 0.0)
            system.external_forces[2, -1] += heard
            if drag:
                v = system.velocity_collection
                system.external_forces -= drag * LENGTH / ELEMENTS * np.abs(v) * v

    system = System()
    rod = ea.CosseratRod.straight_rod(
        ELEMENTS,
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        LENGTH,
        RADIUS,
        DENSITY,
        youngs_modulus=modulus,
        shear_modulus=modulus / 2.8,
    )
    system.append(rod)
    system.constrain(rod).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    system.add_forcing_to(rod).using(Loads)
    system.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=loss, time_step=STEP
    )
    system.finalize()
    stepper, time, rows = ea.PositionVerlet(), np.float64(0.0), [[0.0]]
    for after in run.time_s[1:]:
        for _ in range(round((after - time) / STEP)):
            time = stepper.step(system, time, np.float64(STEP))
        rows.append([float(rod.position_collection[2, -1])])
    return np.array(rows)


def rod(
    seed: int,
    *,
    hidden: Mapping[str, float | None] | None = None,
    **causes: float,
) -> Case:
    """A soft rod that is pushed at its tip, the tip's height measured to 0.4 mm.

    Args:
        seed: Of true parameters and noise.
        hidden: What is hidden, with its size in the library's unit.
        **causes: Of ``bend``.
    """
    rng = np.random.default_rng(seed)
    ramp = np.minimum(TIME / 0.2, 1.0)
    slow = np.interp(TIME, [0, 0.3, 0.7, 1.0, 1.5, 1.8, 2], [0, 0.12, 0.12, -0.1, -0.1, 0, 0])
    commands = {
        "sine": {"force": 0.08 * np.sin(5.0 * TIME) * ramp},
        "steps": {"force": slow},
        "mixed": {"force": 0.04 * (np.sin(4.0 * TIME) + np.sin(11.0 * TIME)) * ramp},
    }
    modulus, loss = off(rng, 2e7, 0.1), off(rng, 1.0, 0.2)
    stiffness = 3.0 * 2e7 * np.pi * RADIUS**4 / 4.0 / LENGTH**3
    mass = 0.243 * DENSITY * np.pi * RADIUS**2 * LENGTH
    model = {
        "system": "ode",
        "states": {"z": "0 m", "v": "0 m/s"},
        "rates": {"z": "v", "v": "(force - stiffness*z)/mass - loss*v"},
        "inputs": ["force"],
        "parameters": {
            "stiffness": {"value": float(stiffness), "percent": 20, "unit": "N/m"},
            "mass": {"value": float(mass), "percent": 10, "unit": "kg"},
            "loss": {"value": 1.0, "percent": 40, "unit": "1/s"},
            # higher modes follow at once
            "feed": {"value": 0.0, "sd": float(0.03 / stiffness), "unit": "m/N"},
        },
        "readings": {"tip": "z + feed*force"},
        "places": [
            {"name": "tip", "position": "z", "velocity": "v", "inertia": "mass", "unit": "N"}
        ],
    }
    channels = [Channel("tip", "m", "position", sd=4e-4)]
    runs = plan(TIME, commands, "mixed", 1)
    numbers: dict[str, Any] = {"modulus": modulus, "loss": loss, **causes}
    record = partial(bend, **numbers)
    study, clean = recorded("rod", channels, runs, record, model, rng)
    return Case(study, clean, "single" if hidden else "null", hidden or {})


RODS: dict[str, Maker] = {
    "rod_as_described": rod,
    "rod_in_air": partial(rod, drag=2.0, hidden={"square_drag": None}),
    "rod_late_force": partial(rod, late_s=0.03, hidden={"delay": 0.03}),
    "rod_meets_a_stop": partial(rod, stop=0.02, hidden={"stop_above": None}),
}
