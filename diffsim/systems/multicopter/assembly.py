"""A described multicopter put together: quantities by name, law of thrusts, windows, causes.

The frequency of a gust that nobody stated is that which the records show.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import channels_of, clock_of
from diffsim.causes.scales import Scales
from diffsim.copter import Multicopter
from diffsim.copter._shipped import beside_or_shipped
from diffsim.copter.design.design_file import load_design
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.copter.vehicle.rotor import RotorModel, rotor_model
from diffsim.core.arrays import Array
from diffsim.core.rotation import matrix_from_rpy
from diffsim.data.study import Run, Study
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.multicopter.cutting import LONGEST, LONGEST_S, Cutter
from diffsim.systems.multicopter.described import DescribedFlights
from diffsim.systems.multicopter.effects import ESTIMATOR_GAINS, SLING_M
from diffsim.systems.multicopter.frames import AXES, RecordingFrames
from diffsim.systems.multicopter.keys import MulticopterKeys
from diffsim.systems.multicopter.scene import CopterScene, rotor_names
from diffsim.systems.multicopter.sensing import sensing_of
from diffsim.systems.multicopter.shooting import SPREAD
from diffsim.systems.multicopter.thrust_law import ThrustLaw

VEHICLE, GUST = "vehicle", "gust"  # places of their magnitudes in the record
_GAINS = {"thrust_gain": 5.0, "torque_gain": 20.0, "inertia_gain": 10.0}  # [%]


def assembled(of: MulticopterKeys, study: Study) -> DescribedFlights:
    """Recipe of the scenes of a study's runs.

    Args:
        study: Study whose channels and commands the description names.
    """
    design = _load_vehicle(of, study)
    rotor = None if of.rotor_model is None else rotor_model(of.rotor_model)
    frames = RecordingFrames(of.frames.world, of.frames.body)
    parameters = BaseParameters(dict(_list_quantities(of, design, rotor)), study.runs)
    law = ThrustLaw(commands=of.commands, thrust=of.thrust, rotor=rotor, battery=of.battery)
    known = {k: torch.tensor(q.value).double() for k, q in parameters.quantities.items()}
    mass, count = float(known["mass"]), len(of.commands.columns)
    hover = mass * GRAVITY / count
    kept = Scales.kept_in(study)
    full_thrust = of.max_thrust if kept is None else kept.plain[VEHICLE]["full_thrust"]
    if full_thrust is None:
        runs = study.fit_runs or study.runs
        full_thrust = max(2.0 * hover, *(float(law.thrusts(run, known).max()) for run in runs))
    sensing, names = sensing_of(of.sensors, study), [c.name for c in study.channels]
    lag_of = of.lag_of or ("thrust" if of.commands.meaning == "thrust" else "speed")
    return DescribedFlights(
        parameters=parameters,
        law=law,
        rotors=of.rotors,
        design=design,
        cutter=Cutter(
            sensors=sensing.groups,
            columns=sensing.columns,
            frames=frames,
            sd=sensing.sd,
            window_s=of.windows.length,
            rigid_spread=SPREAD,
            past_spread=0.5 * hover,  # of what hovers
            longest_s=LONGEST_S if kept is None else kept.facts[LONGEST],
        ),
        substeps=of.windows.substeps,
        radius=_find_radius(of, rotor),
        max_thrust=of.max_thrust,
        full_thrust=full_thrust,
        thrust_coefficient=float(known["thrust_coefficient"])
        if law.is_squared
        else CopterScene.thrust_coefficient,
        lags_speed=lag_of == "speed",
        clocks={
            clock_of(name): tuple(names.index(c) for c in channels_of(study.channels, name))
            for name in of.clocks
        },
    )


def usual_magnitudes(flights: DescribedFlights, study: Study) -> Scales:
    """Magnitudes of thrusts, channels and vehicle; of a saved model those of its fit."""
    if (kept := Scales.kept_in(study)) is not None:
        return kept
    nominal, fleet = flights.nominal(), flights.nominal_fleet()
    names, asked = rotor_names(fleet.num_rotors), []
    for run in study.runs:
        thrusts = flights.asked(run, flights.in_run(nominal, run))[0].numpy().T
        asked.append(replace(run, command=dict(zip(names, thrusts, strict=True))))
    vehicle = {
        "mass": float(fleet.mass),
        "arm": float(fleet.positions[..., :2].norm(dim=-1).max()),
        "full_thrust": flights.full_thrust,
    }
    return replace(
        Scales.of_runs(replace(study, runs=tuple(asked))),
        plain={VEHICLE: vehicle, **_find_axis_magnitudes(flights, study)},
        facts={LONGEST: flights.cutter.longest_s},
    )


def _find_axis_magnitudes(flights: DescribedFlights, study: Study) -> dict[str, dict[str, float]]:
    """Magnitudes along each axis of the recording's world, at which forces may act."""
    cutter = flights.cutter
    states = torch.cat([cutter.record(run).states for run in study.fit_runs or study.runs])
    way, velocity = (cutter.frames.in_world(part) for part in (states[:, :3], states[:, 6:9]))
    # [m/s^2]: a force per mass that is no surprise, as of wind
    push = 0.2 * float(flights.nominal_fleet().mass)
    return {
        axis: {
            "push": push,
            "distance": float(way[:, i].std()) or 1.0,
            "speed": float(velocity[:, i].square().mean().sqrt()) or 1.0,
        }
        for i, axis in enumerate(AXES)
    }


def with_gust(flights: DescribedFlights, study: Study, scales: Scales) -> Scales:
    """Magnitudes with the frequency of a gust and its spread [Hz], as the records suggest.

    Args:
        scales: Magnitudes; new runs of a saved model have its frequency.
    """
    if GUST in scales.plain:
        return scales
    frequency, sd = strongest_frequency(flights, study.fit_runs or study.runs)
    return replace(scales, plain={**scales.plain, GUST: {"frequency": frequency, "sd": sd}})


def with_shapes(
    of: MulticopterKeys,
    flights: DescribedFlights,
    study: Study,
    causes: Sequence[str],
    scales: Scales,
) -> DescribedFlights:
    """The recipe with what causes need beside a size: length of a string, gains of an estimator.

    Args:
        causes: Names of the candidate causes.
        scales: Magnitudes, with those of a gust if that is a cause and its frequency not stated.
    """
    more: dict[str, Quantity] = {}
    if "slung_load" in causes:
        usual = Quantity(value=SLING_M, percent=60.0, unit="m").as_usual()
        more["sling_length"] = of.sling_length or usual
    if "gust" in causes:
        given: Quantity | None = of.gust_frequency
        if given is None:
            value, sd = (scales.plain[GUST][of_it] for of_it in ("frequency", "sd"))
            given = Quantity(value=value, sd=sd, lower=0.1 * value, unit="Hz").as_usual()
        more["gust_frequency"] = given
    if "blind_estimator" in causes:
        assert of.estimator is not None
        more |= {f"estimator_{k}": getattr(of.estimator, k) for k in ESTIMATOR_GAINS}
    quantities = {**flights.parameters.quantities, **more}
    return replace(flights, parameters=BaseParameters(quantities, study.runs))


def _list_quantities(
    of: MulticopterKeys, design: Multicopter | None, rotor: RotorModel | None
) -> Iterator[tuple[str, Quantity]]:
    """Everything that may be fitted, by name of the base parameter."""
    if of.mass is not None:
        yield "mass", of.mass
    elif design is not None:
        yield "mass", Quantity(value=float(design.mass), unit="kg")
    for axis in "xyz":
        yield f"center_of_mass_{axis}", getattr(of.center_of_mass, axis)
    for i in range(len(of.commands.columns)):
        one = Quantity(value=1.0)
        yield f"rotor_{i + 1}_share", of.rotors[i].share if of.rotors else one
    for i, place in enumerate(of.rotors):
        for axis in "xyz":
            yield f"rotor_{i + 1}_{axis}", getattr(place.at, axis)
    if of.inertia is not None:
        for entry in ("xx", "yy", "zz", "xy", "xz", "yz"):
            yield f"inertia_{entry}", getattr(of.inertia, entry)
    if of.thrust is not None and of.thrust.coefficient is not None:
        yield "thrust_coefficient", of.thrust.coefficient
    if (ratio := _find_torque_ratio(of, rotor)) is not None:
        yield "torque_ratio", ratio
    yield from _list_gains(of)
    if of.motor_lag is not None:
        yield "motor_lag", of.motor_lag
    yield from _list_nuisances(of)


def _list_gains(of: MulticopterKeys) -> Iterator[tuple[str, Quantity]]:
    """Factors; each is held by default where what it multiplies is fitted itself."""
    inertia = of.inertia
    fitted = {
        "thrust_gain": of.thrust is not None
        and of.thrust.coefficient is not None
        and of.thrust.coefficient.is_fitted,
        "torque_gain": of.torque_ratio is not None and of.torque_ratio.is_fitted,
        "inertia_gain": inertia is not None
        and any(getattr(inertia, e).is_fitted for e in type(inertia).model_fields),
    }
    for name, percent in _GAINS.items():
        given: Quantity | None = getattr(of, name)
        default = Quantity(value=1.0, percent=None if fitted[name] else percent)
        yield name, default if given is None else given


def _list_nuisances(of: MulticopterKeys) -> Iterator[tuple[str, Quantity]]:
    keys = of.nuisances
    gain = 100.0 * keys.run_thrust_gain
    yield (
        "run_thrust_gain",
        Quantity(value=1.0, percent=gain, per="run") if gain > 0.0 else Quantity(value=1.0),
    )
    sensors = of.sensors
    force = (sensors.specific_force, sensors.specific_force_in_world, sensors.acceleration)
    offsets = {
        "attitude_offset": (keys.attitude_offset, "rad", _sees_attitude(of)),
        "body_rates_offset": (keys.body_rates_offset, "rad/s", sensors.body_rates is not None),
        "specific_force_offset": (
            keys.specific_force_offset,
            "m/s^2",
            any(f is not None for f in force),
        ),
    }
    for name, (sd, unit, is_there) in offsets.items():
        for axis in "xyz":
            if is_there and sd > 0.0:
                yield f"{name}_{axis}", Quantity(value=0.0, sd=sd, unit=unit)
    yield from ((clock_of(name), q) for name, q in of.clocks.items())
    if keys.clock > 0.0:
        yield "clock", Quantity(value=0.0, sd=keys.clock, unit="s", per="run")


def _sees_attitude(of: MulticopterKeys) -> bool:
    return of.sensors.quaternion is not None or of.sensors.roll_pitch_yaw is not None


def _find_torque_ratio(of: MulticopterKeys, rotor: RotorModel | None) -> Quantity | None:
    if of.torque_ratio is not None:
        given: Quantity = of.torque_ratio
        return given
    if of.torque_coefficient is not None:
        assert of.thrust is not None and of.thrust.coefficient is not None
        ratio = of.torque_coefficient / of.thrust.coefficient.value
        return Quantity(value=ratio, unit="m")
    if rotor is not None and of.design is None:
        if rotor.torque_ratio is None:
            raise ValueError(f"the torque of {rotor.name} was not measured; give torque_ratio")
        return Quantity(value=float(rotor.torque_ratio), unit="m")
    return None


def _find_radius(of: MulticopterKeys, rotor: RotorModel | None) -> float:
    if of.radius is not None:
        return float(of.radius)
    return 0.0 if rotor is None else float(rotor.radius)


def _load_vehicle(of: MulticopterKeys, study: Study) -> Multicopter | None:
    """The vehicle of the design file, beside study.yaml or shipped."""
    if of.design is None:
        return None
    design = load_design(beside_or_shipped(study.folder or Path(), of.design, "model.design"))
    vehicle = design.multicopter().detach()
    if vehicle.num_rotors != len(of.commands.columns):
        raise ValueError(
            f"model.commands.columns: design {of.design} has {vehicle.num_rotors} rotors, got "
            f"{len(of.commands.columns)} columns"
        )
    return vehicle


def strongest_frequency(flights: DescribedFlights, runs: Sequence[Run]) -> tuple[float, float]:
    """Frequency [Hz] that explains most of the horizontal force left over, and its spread.

    In every run on its own the force is fitted by a constant, by the velocity, and by a sine and a
    cosine; frequencies slower than one period per record are left out.

    Args:
        flights: Recipe of the scenes, whose nominal vehicle the forces are left over by.
    """
    records = [_find_residuals(flights, run) for run in runs]
    longest = max(float(t[-1] - t[0]) for t, _, _ in records)
    step = 1.0 / (8 * longest)  # frequencies per inverse length of the longest record
    tried = np.arange(1.0 / longest, 3.0, step)
    if len(tried) == 0:
        return 1.0, 0.5
    left = [sum(_compute_misfit(f, *record) for record in records) for f in tried]
    return float(tried[int(np.argmin(left))]), 0.5 / longest


def _find_residuals(flights: DescribedFlights, run: Run) -> tuple[Array, Array, Array]:
    """Times, accelerations (num_samples, 2) and velocities (num_samples, 2) of a run."""
    record = flights.cutter.record(run)
    known = {
        k: torch.tensor(q.value, dtype=torch.float64)
        for k, q in flights.parameters.quantities.items()
    }
    fleet = flights.nominal_fleet()
    rotation = matrix_from_rpy(record.states[:, 3:6])
    pushed: Tensor = flights.asked(run, known)[0] @ fleet.directions[0] / fleet.mass
    world = (rotation * pushed[:, None]).sum(-1)
    world[:, 2] += GRAVITY
    left = record.acceleration - world
    return run.time_s, left[:, :2].numpy(), record.states[:, 6:8].numpy()


def _compute_misfit(frequency: float, time: Array, left: Array, velocity: Array) -> float:
    angle = 2.0 * np.pi * frequency * time
    known = np.column_stack([np.ones_like(time), velocity, np.sin(angle), np.cos(angle)])
    best = np.linalg.lstsq(known, left, rcond=None)[0]
    return float(((left - known @ best) ** 2).sum())
