"""Diagnosis of flights of the virtual laboratory ``labs.virtual.CopterLab``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from diffsim.causes.listing import list_causes
from diffsim.core.schema import read_part
from diffsim.data.study import Study
from diffsim.identify.effect import Effect
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.multicopter import CopterModel, copter_plant
from diffsim.systems.multicopter.description import MulticopterDescription

COMMANDS = tuple(f"command_{i}_N" for i in range(4))
#: Keys of ``sensors`` by the kind of a laboratory's channel.
SENSORS = {
    "position": "position",
    "angle": "roll_pitch_yaw",
    "angular_velocity": "body_rates",
    "specific_force": "specific_force",
}
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


def setup(study: Study, *, window_s: float = 0.5) -> DiagnosisSetup:
    """Model, causes and further runs.

    Args:
        study: Study made by the laboratory.
        window_s: Length of the windows whose initial states are fitted away [s].
    """
    effects = causes(len(COMMANDS))
    keys = describe(study) | {
        "windows": {"length": window_s},
        "effects": {"only": [effect.name for effect in effects]},
    }
    given = read_part(MulticopterDescription, keys, "multicopter").setup(study)
    assert isinstance(given.model, CopterModel)
    # commands that are thrusts do not tell how fast rotors turn
    coefficient = study.metadata["thrust_coefficient_N_s2"]
    flights = replace(given.model.flights, thrust_coefficient=coefficient)
    return replace(given, model=CopterModel(flights, given.model.base), effects=effects)


def describe(study: Study) -> dict[str, Any]:
    """``model:`` of a study whose metadata are the laboratory's facts.

    Args:
        study: Study made by the laboratory.
    """
    facts = study.metadata
    vehicle, known, spread = facts["vehicle"], facts["base_priors"], facts["nuisances"]

    def sized(name: str) -> dict[str, float]:
        return {"value": known[name]["value"], "percent": 100.0 * known[name]["relative_sd"]}

    sensors: dict[str, list[str]] = {}
    for channel in study.channels:
        sensors.setdefault(SENSORS[channel.kind], []).append(channel.name)
    return {
        "system": "multicopter",
        "frames": {"world": "NED", "body": "FRD"},
        "mass": sized("mass"),
        "inertia": np.diag(vehicle["inertia_kg_m2"]).tolist(),
        "rotors": [
            {"at": list(place), "spin": "cw" if spin > 0.0 else "ccw"}
            for place, spin in zip(vehicle["positions_m"], vehicle["spins"], strict=True)
        ],
        "torque_ratio": sized("torque_ratio"),
        "radius": float(vehicle["radii_m"][0]),
        "max_thrust": float(vehicle["max_thrusts_N"][0]),
        "thrust_gain": sized("thrust_gain"),
        "inertia_gain": sized("inertia_scale"),
        "commands": {"columns": list(COMMANDS), "as": "thrust"},
        "battery": "voltage_V",
        "sensors": sensors,
        "nuisances": {
            "run_thrust_gain": facts["gain_jitter"],
            "attitude_offset": spread["camera_to_body_sd_rad"],
            "specific_force_offset": spread["accelerometer_offset_sd_m_s2"],
        },
    }
