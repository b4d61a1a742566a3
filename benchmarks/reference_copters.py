"""Reference results of multicopters: hover, control, flight, the simulator, co-design."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from benchmarks.reference_values import gradients, leaf, weighted_sum

F64 = torch.float64
FIELDS = ("position", "quaternion", "velocity", "body_rates", "thrusts", "charge")


def _tilted() -> tuple[Any, dict[str, Any]]:
    """The pentacopter's payload design with leaves for mass and places of its rotors."""
    from diffsim.copter import load_design

    vehicle = load_design("pentacopter_payload").multicopter().detach()
    leaves = {"mass": leaf(vehicle.mass), "positions": leaf(vehicle.positions)}
    return vehicle.replace(**leaves), leaves


def hover_lqr() -> Mapping[str, Any]:
    """Hover, linear models, LQR gain and metrics of a tilted pentacopter, with gradients."""
    from diffsim import copter

    vehicle, leaves = _tilted()
    found: dict[str, Any] = {}
    for name, smoothing in (("hard", 0.0), ("smooth", 1e-3)):
        held = copter.hover(vehicle, smoothing=smoothing, load=2.0)
        found[name] = {
            "thrusts": held.thrusts,
            "attitude": held.attitude,
            "multipliers": held.multipliers,
            **gradients(weighted_sum(held.thrusts, held.attitude), **leaves),
        }
    held = copter.hover(vehicle)
    for form in ("euler", "rotation_vector"):
        model = copter.linearize(vehicle, held.thrusts, held.attitude, form=form)
        weights = leaf([1.0] * 6 + [0.1] * 6), leaf([0.5] * vehicle.num_rotors)
        gain = copter.lqr(model.A, model.B, torch.diag(weights[0]), torch.diag(weights[1]))
        found[form] = {
            "A": model.A,
            "B": model.B,
            "K": gain.K,
            "P": gain.P,
            "lyapunov": copter.lyapunov(model.A - model.B @ gain.K, torch.eye(12, dtype=F64)),
            "response_time": copter.response_time(*(m.detach() for m in (*model, gain.K))),
            **gradients(weighted_sum(gain.K), q=weights[0], r=weights[1], **leaves),
        }
    rigid = vehicle.detach()
    found["max_weight"] = copter.max_hover_weight(rigid)
    found["authority"] = copter.control_authority(rigid)
    found["rotor_out"] = copter.rotor_out_margins(rigid)
    return found


def flight() -> Mapping[str, Any]:
    """Closed-loop flights of two vehicles with drag, lag, wind and ground, and gradients."""
    from diffsim import copter
    from diffsim.copter.vehicle import effects

    vehicle, leaves = _tilted()
    held = copter.hover(vehicle.detach())
    model = copter.linearize(vehicle.detach(), held.thrusts, held.attitude)
    state_cost = torch.diag(torch.tensor([1.0] * 6 + [0.1] * 6, dtype=F64))
    gain = leaf(copter.lqr(model.A, model.B, state_cost, torch.eye(5, dtype=F64)).K)
    rng, steps = np.random.default_rng(0), 40
    start = leaf(0.1 * rng.standard_normal((2, 12)) - np.array([0.0, 0.0, 1.0] + [0.0] * 9))
    wind, lag = leaf(rng.normal(0.0, 2.0, (steps, 3))), leaf([0.05] * 5)
    commands = leaf(held.thrusts.expand(1, steps, -1))
    reference = torch.cat([torch.tensor([0.0, 0.0, -1.0], dtype=F64), torch.zeros(9, dtype=F64)])
    several = effects.FlightEffects(
        motor_lag=effects.MotorLag(time_constants=lag),
        rotor_drag=effects.RotorDrag(coefficient=leaf(0.05)),
        body_drag=effects.BodyDrag(linear=leaf([0.1, 0.2, 0.3]), quadratic=leaf([0.1, 0.1, 0.2])),
        ground_effect=effects.GroundEffect(coefficient=leaf(1.2), terrain_height=leaf(0.0)),
        wind=wind,
    )
    flown = copter.fly(
        vehicle,
        copter.FlightState.from_minimal(start),
        commands,
        dt=0.02,
        feedback=copter.Feedback(gain=gain, reference=reference),
        effects=several,
        substeps=2,
        num_threads=1,
    )
    ends = [getattr(flown.state, name) for name in FIELDS]
    inputs = {"start": start, "wind": wind, "lag": lag, "gain": gain, "commands": commands}
    return {
        **dict(zip(FIELDS, ends, strict=True)),
        "minimal": flown.state.minimal(),
        **gradients(weighted_sum(*ends), **inputs, **leaves),
    }


def flight_simulator() -> Mapping[str, Any]:
    """Three seconds of the shipped hover mission with noisy sensors, by LQR and by PID."""
    from diffsim.copter import load_design
    from diffsim.copter.simulator import FlightSimulator, load_mission

    found = {}
    for controller in ("lqr", "pid"):
        simulator = FlightSimulator(load_design("quadcopter"), controller=controller, seed=0)
        log = simulator.run(load_mission("hover"), seconds=3.0)
        names = ("position", "quaternion", "estimate", "pwm", "thrusts", "voltage", "charge")
        found[controller] = {name: log.series(name) for name in names}
    return found


def pentacopter_payload() -> Mapping[str, Any]:
    """The pentacopter's largest payload: jointly, with torque kept, and by the thesis's method."""
    from diffsim.copter import load_design
    from diffsim.copter.codesign import Demands, Limits, SearchOptions, codesign

    design = load_design("pentacopter")
    apart, two = Limits(clearance=0.01), SearchOptions(num_starts=2)
    cases: dict[str, dict[str, Any]] = {
        "joint": {"limits": apart, "search": two},
        "torque_kept": {
            "limits": Limits(clearance=0.01, extent=0.3),
            "demands": Demands(authority=(0.5, 0.5, 0.05)),
            "search": two,
        },
        "slsqp": {"limits": apart, "search": SearchOptions(num_starts=2, solver="slsqp")},
        "alternating": {"search": SearchOptions(num_starts=1), "method": "alternating"},
    }
    found = {}
    for name, options in cases.items():
        best = codesign(design, "payload", **options)
        found[name] = {
            "max_payload": best.max_payload,
            "max_weight": best.max_weight,
            "objective": best.objective,
            "bound": best.bound,
            "shape": best.s,
            "directions": best.directions,
            "spins": best.spins,
            "thrusts": best.thrusts,
            "attitude": best.attitude,
            "history": best.history,
            "iterations": [start.num_iters for start in best.starts],
        }
    return found


def rotor_fits() -> Mapping[str, Any]:
    """Rotor models fitted to the measured thrust stand."""
    from diffsim.copter.vehicle.fit_rotor import fit_rotor
    from diffsim.copter.vehicle.rotor_table import read_rotor_bench
    from diffsim.data import find_dataset

    folder = find_dataset("rotor_bench")
    if folder is None:
        raise FileNotFoundError("no measured data; set DIFFSIM_DATA")
    found = {}
    for name, table in read_rotor_bench(folder).items():
        made = fit_rotor(table)
        found[name] = [value for fit in made.curves.values() for value in fit.values.values()]
    return found


ITEMS = {
    f.__name__: f for f in (hover_lqr, flight, flight_simulator, pentacopter_payload, rotor_fits)
}
