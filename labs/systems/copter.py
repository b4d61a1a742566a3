"""Diagnosis of flights of the virtual laboratory ``labs.virtual.CopterLab``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.causes.listing import list_causes
from diffsim.copter import GRAVITY, Feedback, FlightState, Multicopter, fly, linearize, lqr
from diffsim.data.study import Run, Study
from diffsim.identify import Parameter
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.multicopter import (
    copter_plant,
    flight_model,
    flight_nuisances,
    unknown_wrench,
)
from diffsim.systems.multicopter.paths import PATHS, Path

Array = NDArray[np.float64]

COMMANDS = tuple(f"command_{i}_N" for i in range(4))
SENSOR_KINDS = {
    "position": "position",
    "angle": "attitude",
    "angular_velocity": "body_rates",
    "specific_force": "accelerometer",
}
BASE = {
    "mass": "mass_gain",
    "thrust_gain": "thrust_gain",
    "inertia_scale": "inertia_gain",
    "torque_ratio": "torque_gain",
}
BANK_S, BANK_HZ = 4.0, 100.0
FACTS = (
    "thrusts",
    "battery",
    "radius",
    "down",
    "sees_position",
    "sees_rates",
    "sees_unit",
    "sees_force",
)
CAUSES = (
    *("quantization", "rotor_drag", "body_drag", "parasitic_drag", "wind", "body_tilt"),
    *("voltage_exponent", "center_of_mass", "ground_effect", "inflow", "wake"),
    *("thrust_curvature", "gyroscopic", "placement", "sensor_tilt", "sensor_scale"),
    *("accelerometer_scale", "gyro_offset", "lag", "delay"),
)
OF_ROTOR = ("weak_rotor", "thrust_loss", "torque_loss", "rotor_tilt")


def causes(num_rotors: int = 4) -> tuple[Effect, ...]:
    """Causes that the laboratory may hide, of a usual vehicle.

    Args:
        num_rotors: Number of rotors.
    """
    plant = copter_plant(num_rotors, 1.0, 0.25, FACTS)
    known = {effect.name: effect for effect in list_causes(plant)}
    of_rotors = (f"{name}_{i + 1}" for i in range(num_rotors) for name in OF_ROTOR)
    return tuple(known[name] for name in (*CAUSES, *of_rotors))


def setup(study: Study, *, window_s: float = 0.5, knot_s: float = 0.2) -> DiagnosisSetup:
    """Model, causes and further runs.

    Args:
        study: Study made by the laboratory.
        window_s: Length of the windows whose initial states are fitted away [s].
        knot_s: Between the knots of the unknown wrench [s].
    """
    vehicle = _vehicle(study.metadata)
    channels = {SENSOR_KINDS[c.kind]: c.sd for c in study.channels}
    nuisances = study.metadata["nuisances"]
    model = flight_model(
        vehicle,
        commands=COMMANDS,
        sensors=tuple(channels),
        sensor_sd={name: sd for name, sd in channels.items() if sd is not None},
        window_s=window_s,
        base=(
            *_base(study.metadata["base_priors"]),
            *flight_nuisances(
                [run.name for run in study.runs],
                nuisances["camera_to_body_sd_rad"],
                nuisances["accelerometer_offset_sd_m_s2"],
                study.metadata["gain_jitter"],
            ),
        ),
        thrust_coefficient=study.metadata["thrust_coefficient_N_s2"],
    )
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in study.runs)
    knots = np.linspace(0.0, longest, max(2, round(longest / knot_s) + 1))
    smooth = smooth_covariance(knots, 2.0 * knots[1])
    covariance = np.kron(np.eye(6), smooth).astype(np.float64)
    wrench = UnknownForce(unknown_wrench(len(knots), longest), covariance, "unknown wrench")
    return DiagnosisSetup(
        model,
        causes(vehicle.num_rotors),
        (wrench,),
        bank(vehicle),
        DiagnosisSettings(),
    )


def bank(vehicle: Multicopter) -> tuple[Run, ...]:
    """Flights that could be recorded next, as the nominal vehicle would fly them."""
    loaded = vehicle.replace(mass=vehicle.mass + 0.3)
    flights: dict[str, tuple[Multicopter, Path, dict[str, float]]] = {}
    for name, path in PATHS.items():
        flights[name] = vehicle, path, {}
        if name == "low_hover":
            flights["hover_with_payload"] = loaded, PATHS["hover"], {"payload_kg": 0.3}
    runs = [_flown(name, *flight) for name, flight in flights.items()]
    yawed = [_yawed(run) for run in runs if run.name in ("hover", "fast_forward")]
    return (*runs, *yawed)


def _vehicle(facts: Mapping[str, Any]) -> Multicopter:
    given = {name: _f64(value) for name, value in facts["vehicle"].items()}
    base = facts["base_priors"]
    return Multicopter(
        mass=_f64(base["mass"]["value"]),
        inertia=given["inertia_kg_m2"],
        positions=given["positions_m"],
        directions=given["directions"],
        spins=given["spins"],
        torque_ratios=torch.full_like(given["spins"], base["torque_ratio"]["value"]),
        max_thrusts=given["max_thrusts_N"],
        radii=given["radii_m"],
    )


def _f64(value: Any) -> Tensor:
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)


def _base(priors: Mapping[str, Mapping[str, Any]]) -> list[Parameter]:
    """Factors on what was designed."""
    return [
        Parameter(name, 1.0, priors[given]["relative_sd"], log=True) for given, name in BASE.items()
    ]


def _flown(name: str, vehicle: Multicopter, path: Path, facts: Mapping[str, float]) -> Run:
    """Under feedback about hover, without noise: what a diagnosis asks of a run not yet made."""
    count, dt = round(BANK_S * BANK_HZ), 1.0 / BANK_HZ
    t = dt * torch.arange(count, dtype=torch.float64)
    aim = path(t)
    hover = torch.full((vehicle.num_rotors,), float(vehicle.mass) * GRAVITY / vehicle.num_rotors)
    hover = hover.to(torch.float64)
    linear = linearize(vehicle, hover, torch.zeros(2, dtype=torch.float64))
    eye = torch.eye(12, dtype=torch.float64)
    gain = lqr(linear.A, linear.B, eye, torch.eye(vehicle.num_rotors, dtype=torch.float64)).K
    state = fly(
        vehicle,
        FlightState.at_rest(aim[:1, :3], aim[:1, 3:6]),
        hover.expand(1, count, -1).contiguous(),
        dt=dt,
        substeps=2,
        feedback=Feedback(gain=gain, reference=aim),
    ).state
    assert state.thrusts is not None
    rotation = 0.5 * (state.rotation[0, 1:] + state.rotation[0, :-1])
    proper = state.velocity[0].diff(dim=0) / dt - _f64([0.0, 0.0, GRAVITY])
    specific = (rotation.mT @ proper[..., None])[..., 0]
    specific = torch.cat([_f64([[0.0, 0.0, -GRAVITY]]), specific])[:count]
    seen = [state.position, state.rpy, state.body_rates]
    measured = torch.cat([*(value[0, :count] for value in seen), specific], -1).numpy()
    thrusts = state.thrusts[0, 1:].numpy()
    command = {c: thrusts[:, i] for i, c in enumerate(COMMANDS)}
    command["voltage_V"] = np.full(count, 12.0)
    return Run(name, t.numpy(), measured, command, name, setup=dict(facts))


def _yawed(run: Run) -> Run:
    """The same flight with the nose to the east: the world turned by 90 degrees."""
    measured = run.measured.copy()
    measured[:, 0], measured[:, 1] = -run.measured[:, 1], run.measured[:, 0]
    measured[:, 5] += 0.5 * np.pi
    name = f"{run.name}_yawed_90"
    return Run(name, run.time_s, measured, run.command, name, setup=dict(run.setup))
