"""Flights that could be recorded next, as the nominal vehicle would fly them.

Paths are states of 12 over time, north-east-down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from diffsim.copter import GRAVITY, Feedback, FlightState, Multicopter, fly, linearize, lqr
from diffsim.copter.vehicle.multicopter import NUMBERS
from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.systems.multicopter.described import DescribedFlights
from diffsim.systems.multicopter.readings import RecordedScene, SensedRecord, read
from diffsim.systems.multicopter.scene import flight_grid
from diffsim.systems.multicopter.shooting import RIGID, Windows


def flights_to_record(flights: DescribedFlights, runs: Sequence[Run]) -> tuple[Run, ...]:
    """Hover high and low, with a payload, fast forward, climb, weave and turn, without noise.

    Flights that the nominal vehicle cannot hold are left out.

    Args:
        flights: Recipe of the scenes; its nominal vehicle flies under feedback about hover.
        runs: Recorded runs; the first one's set-up and other commands are kept.
    """
    vehicle = _build_vehicle(flights)
    if vehicle.num_rotors < 4:  # nothing that such feedback could hold
        return ()
    payload = 0.2 * float(vehicle.mass)
    heavier = vehicle.replace(mass=vehicle.mass + payload)
    wanted = [(name, vehicle, path, 0.0) for name, path in PATHS.items()]
    wanted.append(("hover_with_payload", heavier, PATHS["hover"], payload))
    out = []
    for name, flying, path, load in wanted:
        try:
            out.append(_fly_path(name, flights, flying, path, runs[0], load))
        except DiffsimError:  # nothing to record there, and no reason to stop
            continue
    return tuple(out)


def _build_vehicle(flights: DescribedFlights) -> Multicopter:
    fleet = flights.nominal_fleet()
    values = {name: getattr(fleet, name)[0].detach() for name in NUMBERS}
    top = torch.full_like(values["radii"], flights.full_thrust)
    return Multicopter(**{**values, "max_thrusts": top})


def _fly_path(
    name: str,
    flights: DescribedFlights,
    vehicle: Multicopter,
    path: Path,
    like: Run,
    payload: float,
) -> Run:
    count, dt = 400, 0.01  # four seconds
    time = dt * torch.arange(count, dtype=torch.float64)
    aim, n = path(time), vehicle.num_rotors
    hover = torch.full((n,), float(vehicle.mass) * GRAVITY / n, dtype=torch.float64)
    linear = linearize(vehicle, hover, torch.zeros(2, dtype=torch.float64))
    weights = torch.eye(12, dtype=torch.float64), torch.eye(n, dtype=torch.float64)
    state = fly(
        vehicle,
        FlightState.at_rest(aim[:1, :3], aim[:1, 3:6]),
        hover.expand(1, count, -1).contiguous(),
        dt=dt,
        substeps=2,
        feedback=Feedback(gain=lqr(linear.A, linear.B, *weights).K, reference=aim),
    ).state
    assert state.thrusts is not None
    thrusts = state.thrusts[0, 1:].detach()
    asked = flights.law.commands_for(thrusts)
    command = {c: asked[:, i].numpy() for i, c in enumerate(flights.law.commands.columns)}
    for other, values in like.command.items():
        command.setdefault(other, np.full(count, float(np.asarray(values)[0])))
    setup = dict(like.setup) | ({"payload_kg": payload} if payload else {})
    measured = _read_channels(flights, vehicle, thrusts, state, dt)
    still = {n: np.full(count, float(values[0])) for n, values in like.columns.items()}
    return Run(name, time.numpy(), measured, command, name, setup=setup, columns=still)


def _read_channels(
    flights: DescribedFlights, vehicle: Multicopter, thrusts: Tensor, state: FlightState, dt: float
) -> np.ndarray:
    """Channels of the study at the start of every step, (num_samples, num_channels)."""
    cutter, count, n = flights.cutter, len(thrusts), vehicle.num_rotors
    nothing = torch.full((1, count, len(cutter.sd)), torch.nan, dtype=torch.float64)
    start = torch.zeros(1, RIGID + n, dtype=torch.float64)
    scene = RecordedScene(
        grid=flight_grid(count, dt),
        sensors=cutter.sensors,
        windows=Windows(start, nothing, cutter.sd),
        columns=cutter.columns,
        frames=cutter.frames,
    )
    # a sample of its own before the start: at rest there
    parts = (state.position, state.velocity, state.rotation, state.quaternion, state.body_rates)
    record = SensedRecord(*(torch.cat([p[:, :1], p[:, :-1]], 1).detach()[None] for p in parts))
    shown: np.ndarray = read(scene, record)[0, 0].numpy()
    return shown


Path = Callable[[Tensor], Tensor]
"""States (num_samples, 12) at times (num_samples,) [s]."""


def rise(t: Tensor) -> Tensor:
    """From 0 to 1 within 2 s and back, smoothly."""
    return 0.5 - 0.5 * torch.cos(0.5 * torch.pi * t)


def path(
    t: Tensor,
    north: Tensor | float = 0.0,
    east: Tensor | float = 0.0,
    height: Tensor | float = 1.0,
    yaw: Tensor | float = 0.0,
) -> Tensor:
    """States of 12 to be followed, (num_samples, 12).

    Args:
        t: Times, (num_samples,) [s].
        north, east, height: Places [m].
        yaw: Heading [rad].
    """
    aim = torch.zeros(len(t), 12, dtype=torch.float64)
    aim[:, 0], aim[:, 1], aim[:, 5] = north, east, yaw
    aim[:, 2] = -torch.as_tensor(height, dtype=torch.float64)
    return aim


PATHS: Mapping[str, Path] = MappingProxyType(
    {
        "hover": path,
        "low_hover": lambda t: path(t, height=0.2),
        "fast_forward": lambda t: path(t, north=4.0 * rise(t)),
        "climb": lambda t: path(t, height=0.5 + 3.0 * rise(t)),
        "weave": lambda t: path(t, east=0.4 * torch.sin(3.0 * t)),
        "turn": lambda t: path(t, yaw=1.5 * rise(t)),
    }
)
"""Six that tell causes apart."""
