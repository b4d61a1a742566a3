"""A ready model of flights under recorded commands, made from a multicopter's design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim._check import require_choice
from diffsim.copter import Multicopter
from diffsim.diagnose.beds.copter.scene import (
    SENSORS,
    CopterScene,
    fly_windows,
    simulate_many,
    steps_of,
    windowed,
)
from diffsim.diagnose.beds.copter.shooting import Shooting, filled, guess_states
from diffsim.diagnose.beds.signals import held_lagged
from diffsim.diagnose.model import Build, Numerics, SimModel
from diffsim.identify import Parameter

if TYPE_CHECKING:
    from diffsim.data.study import Run

FLIGHT_BASE = (
    Parameter("thrust_gain", 1.0, 0.05, log=True),
    Parameter("torque_gain", 1.0, 0.2, log=True),
    Parameter("inertia_gain", 1.0, 0.1, log=True),
    Parameter("motor_time_constant", 0.03, 0.3, "s", log=True),
)
_OFFSETS = ("attitude_offset", "body_rates_offset", "accelerometer_offset")
BASE_NAMES = (
    *(p.name for p in FLIGHT_BASE),
    "mass_gain",
    *(f"{o}_{axis}" for o in _OFFSETS for axis in "xyz"),
)


def flight_nuisances(
    runs: Sequence[str],
    attitude_rad: float = 3e-3,
    accelerometer_m_s2: float = 0.03,
    gain: float = 5e-3,
) -> tuple[Parameter, ...]:
    """Set-up facts that no flight is without: sensor offsets, and the thrust gain of each run."""
    spread = {"attitude_offset": attitude_rad, "accelerometer_offset": accelerometer_m_s2}
    units = {"attitude_offset": "rad", "accelerometer_offset": "m/s^2"}
    offsets = [Parameter(f"{o}_{a}", 0.0, sd, units[o]) for o, sd in spread.items() for a in "xyz"]
    return (*offsets, *(Parameter(f"thrust_gain@{run}", 1.0, gain, log=True) for run in runs))


# Noise of a channel while nothing better is known: motion capture and a small inertial unit.
SENSOR_SD = {"position": 2e-3, "attitude": 5e-3, "body_rates": 1e-2, "accelerometer": 0.1}
_UNEVEN = 1e-3  # of the mean step


class CopterModel(SimModel):
    """A model that flies many parameter points as one batch."""

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """All flights in one call of the kernel."""
        for scene in scenes:
            if not isinstance(scene, CopterScene):
                raise TypeError(f"build must make a CopterScene, got {type(scene).__name__}")
        return simulate_many(scenes)


def flight_model(
    vehicle: Multicopter,
    *,
    commands: Sequence[str],
    sensors: Sequence[str] = ("position", "attitude", "body_rates", "accelerometer"),
    sensor_sd: Mapping[str, float] | None = None,
    window_s: float = 1.0,
    substeps: int = 2,
    base: Sequence[Parameter] = FLIGHT_BASE,
) -> CopterModel:
    """Flights of one vehicle under its recorded thrust commands.

    A run is cut into windows; the initial state of each is fitted away, so no parameter is needed
    for it (:class:`~diffsim.diagnose.beds.copter.shooting.Shooting`). Channels must come in the
    groups of ``sensors``, three columns each, NED; yaw must be free of jumps.

    Args:
        vehicle: As designed.
        commands: Names of the runs' commands, commanded thrust of each rotor in order [N].
        sensors: Groups of channels: "position" and "attitude", with "body_rates" and
            "accelerometer" if there are.
        sensor_sd: Noise by group, in the unit of the group; weighs the fit of initial states.
        window_s: Length of a window [s].
        substeps: Integration steps per sample.
        base: Any of thrust_gain, torque_gain (reaction torque), inertia_gain, mass_gain [-] and
            motor_time_constant [s]; without the last, motors follow at once. Nuisances as
            ``flight_nuisances`` makes them.
    """
    groups = tuple(require_choice("sensors", s, SENSORS) for s in sensors)
    if not {"position", "attitude"} <= set(groups):
        raise ValueError(f'sensors must have "position" and "attitude", got {list(groups)}')
    if len(commands) != vehicle.num_rotors:
        raise ValueError(
            f"commands must name one column per rotor, {vehicle.num_rotors}, got {list(commands)}"
        )
    for parameter in base:
        if not parameter.name.startswith("thrust_gain@"):
            require_choice("base", parameter.name, BASE_NAMES)
    sd_of = SENSOR_SD | dict(sensor_sd or {})
    sd = torch.tensor([sd_of[g] for g in groups for _ in range(3)], dtype=torch.float64)
    prior = {p.name: torch.tensor(p.value, dtype=torch.float64) for p in base}
    prepared: dict[Run, Shooting] = {}

    def scene(
        values: Mapping[str, Tensor], run: Run, factor: float, shooting: Shooting
    ) -> CopterScene:
        unit = torch.ones((), dtype=torch.float64)
        result = CopterScene(
            vehicle=vehicle.replace(
                mass=vehicle.mass * values.get("mass_gain", unit),
                inertia=vehicle.inertia * values.get("inertia_gain", unit),
                torque_ratios=vehicle.torque_ratios * values.get("torque_gain", unit),
            ),
            commands=_columns(run, commands)
            * values.get("thrust_gain", unit)
            * values.get(f"thrust_gain@{run.name}", unit),
            attitude_offset=_vector(values, "attitude_offset"),
            body_rates_offset=_vector(values, "body_rates_offset"),
            accelerometer_offset=_vector(values, "accelerometer_offset"),
            dt=_spacing(run),
            sensors=groups,
            shooting=shooting,
            substeps=max(1, round(substeps / factor)),
            terrain_height=float(run.setup.get("terrain_height_m", 0.0)),
        )
        if "motor_time_constant" in values:
            tau = values["motor_time_constant"]
            result = result.with_command(lambda u, dt: held_lagged(u, dt, tau))
        return result

    def shooting_of(run: Run) -> Shooting:
        if run not in prepared:
            prepared[run] = prepare(run)
        return prepared[run]

    def prepare(run: Run) -> Shooting:
        measured = torch.as_tensor(np.asarray(run.measured), dtype=torch.float64)
        if measured.shape[1] != len(sd):
            raise ValueError(
                f"run {run.name} has {measured.shape[1]} channels, the sensors {list(groups)} need "
                f"{len(sd)}"
            )
        dt = _spacing(run)
        length = min(max(5, round(window_s / dt)), len(measured))
        windows = -(-len(measured) // length)
        whole = filled(measured)
        by_group = {g: whole[:, 3 * i : 3 * i + 3] for i, g in enumerate(groups)}
        states = guess_states(
            by_group["position"], by_group["attitude"], by_group.get("body_rates"), dt
        )
        before = (torch.arange(windows) * length - 1).clamp(min=0)
        start = states[before]
        empty = Shooting(start, measured[:0], measured[:0], measured[:0])
        plain = scene(prior, run, 1.0, empty)
        heard = plain.commands
        for change in plain.command_maps:
            heard = change(heard, dt)
        thrusts = windowed(steps_of(heard), windows, length)

        def predict(starts: Tensor) -> Tensor:
            copies = starts.shape[0] // windows
            return fly_windows([plain], starts[None], thrusts.repeat(copies, 1, 1)[None])[0]

        recorded = torch.full((windows * length, measured.shape[1]), np.nan, dtype=torch.float64)
        recorded[: len(measured)] = measured
        return Shooting.prepare(predict, start, recorded.reshape(windows, length, -1), sd)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> CopterScene:
        return scene(values, run, numerics.time_step, shooting_of(run))

    make: Build = build
    return CopterModel(make, tuple(base), "multicopter")


def _vector(values: Mapping[str, Tensor], name: str) -> Tensor:
    """(3,) of the parameters name_x, name_y, name_z; 0 where there are none."""
    zero = torch.zeros((), dtype=torch.float64)
    return torch.stack([values.get(f"{name}_{axis}", zero) for axis in "xyz"])


def _columns(run: Run, names: Sequence[str]) -> Tensor:
    for name in names:
        require_choice(f"run {run.name}: command", name, run.command)
    rows = [np.asarray(run.command[name], dtype=np.float64) for name in names]
    return torch.from_numpy(np.stack(rows, -1))


def _spacing(run: Run) -> float:
    steps = np.diff(run.time_s)
    dt = float(steps.mean())
    if np.abs(steps - dt).max() > _UNEVEN * dt:
        raise ValueError(
            f"run {run.name}: flights need evenly spaced samples, got steps of {steps.min():.4g} "
            f"to {steps.max():.4g} s; resample the record"
        )
    return dt
