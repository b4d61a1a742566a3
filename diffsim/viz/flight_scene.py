"""Rerun scenes of simulated flights: the design's parts, turning propellers, thrust, plots.

North-west-up (z up). Written to a file afterwards, or shown while the flight goes on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.copter.design.design import Design
from diffsim.copter.simulator import FlightLog, FlightSample
from diffsim.copter.vehicle.vehicle_record import FlyingVehicle
from diffsim.core.arrays import Array
from diffsim.core.optional import optional
from diffsim.viz.figures import COLORS
from diffsim.viz.flight_shapes import SLOWER, UP, FlightShapes, shapes_of
from diffsim.viz.scene import rgb, write_recording

FRAME_RATE = 30.0  # [Hz]
_METERS_PER_NEWTON = 0.03  # length of a thrust arrow
_CLOCK = "time"
_PLOTS = {"voltage": "V", "current": "A", "charge": ""}


class FlightScene:
    """Logs one flight to a rerun stream, frame by frame.

    Args:
        stream: Stream of type ``rerun.RecordingStream`` that the scene is logged to.
        design: What flies: a design, or a vehicle without parts (arms and discs are drawn).
        payload: Carried below the center of mass [kg].
        drop: Distance below the vehicle [m].
    """

    def __init__(
        self,
        stream: Any,
        design: Design | FlyingVehicle,
        *,
        payload: float = 0.0,
        drop: float = 0.05,
    ):
        self._rr = optional("rerun", purpose="a flight's scene")
        self._stream = stream
        shapes = shapes_of(design)
        vehicle = shapes.vehicle
        self._rotors = shapes.rotors
        shift = np.array([0.0, 0.0, drop]) * payload / (float(vehicle.mass) + payload)
        self._center = shapes.center_of_mass + shift
        self._hubs = vehicle.positions.numpy() - shift
        self._axes = vehicle.directions.numpy()
        self._turns = -vehicle.spins.numpy()  # +1 about the thrust is counter-clockwise from above
        self._angles = np.zeros(len(self._hubs))
        self._names = shapes.rotor_names
        self._last: float | None = None
        self._log_parts(shapes)
        if payload:
            self._log_load(drop - shift[2])
        self._log_plot_names()

    def frame(self, sample: FlightSample) -> None:
        """Log a sample if a frame is due; an observer of ``FlightSimulator.run``."""
        elapsed = 1.0 if self._last is None else sample.time - self._last
        if elapsed < 1.0 / FRAME_RATE - 1e-9:
            return
        self._last = sample.time
        rr, stream = self._rr, self._stream
        stream.set_time(_CLOCK, duration=float(sample.time))
        body = Rotation.from_quat(sample.quaternion[[1, 2, 3, 0]]).as_matrix()
        rotation = UP @ body
        stream.log(
            "world/copter",
            rr.Transform3D(translation=UP @ sample.position, mat3x3=rotation),
        )
        stream.log(
            "world/target",
            rr.Points3D([UP @ sample.target], radii=[0.03], colors=[rgb(COLORS["published"])]),
        )
        arrows = self._axes * (_METERS_PER_NEWTON * sample.thrusts)[:, None]
        colors = [rgb(COLORS["bad" if s else "fitted"]) for s in sample.saturated]
        stream.log(
            "world/copter/thrust", rr.Arrows3D(origins=self._hubs, vectors=arrows, colors=colors)
        )
        self._turn(sample.thrusts, elapsed)
        self._log_numbers(sample)

    def _log_parts(self, shapes: FlightShapes) -> None:
        rr = self._rr
        for name, mesh in shapes.meshes.items():
            motor = name.removesuffix("__propeller")
            propeller = motor in self._names and name != motor
            origin = self._center
            if propeller:  # about its own hub, so that it can turn
                origin = self._center + self._hubs[self._names.index(motor)]
            color = COLORS["third" if propeller else "measured_2"]
            self._stream.log(
                f"world/copter/{name}",
                rr.Mesh3D(
                    vertex_positions=mesh.vertices - origin,
                    triangle_indices=mesh.faces,
                    albedo_factor=[*rgb(color), 255],
                ),
                static=True,
            )

    def _log_load(self, below: float) -> None:
        box = self._rr.Boxes3D(
            centers=[[0.0, 0.0, below + 0.03]],
            sizes=[[0.1, 0.1, 0.06]],
            colors=[rgb(COLORS["fourth"])],
        )
        self._stream.log("world/copter/payload", box, static=True)

    def _log_plot_names(self) -> None:
        rr = self._rr
        for name, unit in _PLOTS.items():
            label = f"{name} [{unit}]" if unit else name
            self._stream.log(f"plots/{name}", rr.SeriesLines(names=[label]), static=True)
        names = [f"motor {k + 1}" for k in range(len(self._names))]
        self._stream.log("plots/pwm", rr.SeriesLines(names=names), static=True)
        self._stream.log(
            "plots/height", rr.SeriesLines(names=["height [m]", "target [m]"]), static=True
        )

    def _turn(self, thrusts: Array, elapsed: float) -> None:
        speeds = [float(r.speed(float(u))) for r, u in zip(self._rotors, thrusts, strict=True)]
        self._angles += self._turns * np.array(speeds) * elapsed / SLOWER
        for name, hub, axis, angle in zip(
            self._names, self._hubs, self._axes, self._angles, strict=True
        ):
            self._stream.log(
                f"world/copter/{name}__propeller",
                self._rr.Transform3D(
                    translation=hub,
                    rotation=self._rr.RotationAxisAngle(axis=axis, radians=float(angle)),
                ),
            )

    def _log_numbers(self, sample: FlightSample) -> None:
        rr, stream = self._rr, self._stream
        for name in _PLOTS:
            stream.log(f"plots/{name}", rr.Scalars(getattr(sample, name)))
        stream.log("plots/pwm", rr.Scalars(sample.pwm))
        stream.log("plots/height", rr.Scalars([-sample.position[2], -sample.target[2]]))


def write_flight(
    path: str | Path, log: FlightLog, design: Design | FlyingVehicle, *, payload: float = 0.0
) -> Path:
    """Write a flight as an ``.rrd`` file, in place of an older one only when it is whole.

    Raises:
        ImportError: rerun-sdk is not installed.
    """
    track = log.series("position") @ UP

    def write(rr: Any, stream: Any) -> None:
        scene = FlightScene(stream, design, payload=payload)
        line = rr.LineStrips3D([track], colors=[rgb(COLORS["fitted"])], radii=[0.005])
        stream.log("world/track", line, static=True)
        for sample in log.samples:
            scene.frame(sample)

    return write_recording(path, f"flight of {design.name}", write)


def live_scene(design: Design | FlyingVehicle, *, payload: float = 0.0) -> FlightScene:
    """Open the rerun viewer; its ``frame`` is an observer of ``FlightSimulator.run``.

    Raises:
        ImportError: rerun-sdk is not installed.
    """
    rr = optional("rerun", purpose="the live viewer")
    stream = rr.RecordingStream(f"diffsim flight of {design.name}")
    stream.spawn()
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    return FlightScene(stream, design, payload=payload)
