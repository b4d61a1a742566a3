"""The page of a simulated flight: the vehicle to turn and play, its numbers and curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.copter.design.design import Design
from diffsim.copter.simulator import FlightLog
from diffsim.copter.vehicle.vehicle_record import FlyingVehicle
from diffsim.core.arrays import Array
from diffsim.viz import charts
from diffsim.viz import report as page
from diffsim.viz.figures import COLORS, CYCLE
from diffsim.viz.flight_shapes import SLOWER, UP, FlightShapes, shapes_of
from diffsim.viz.moving import FRAME_RATE, Line, Moving, Rigid

if TYPE_CHECKING:
    import trimesh


_SAMPLES = 1000  # of a curve, at most: pages stay below 3 MB
_FEW = 300  # triangles; a part of more is drawn as its convex hull


def flight_page(
    log: FlightLog, design: Design | FlyingVehicle, *, payload: float = 0.0
) -> page.Report:
    """The page of a flight: outcome, key figures, the moving vehicle, curves."""
    summary = log.summary()
    saturated = 100.0 * max(summary["saturated_share"])
    load = f", with {payload:g} kg" if payload else ""
    return page.Report(
        title=f"Flight of {design.name}",
        subtitle=f"Simulated, {summary['seconds']:.1f} s{load}",
        verdict=[
            f"The flight ended: {summary['outcome']}. It stayed within "
            f"{summary['greatest_position_error_m']:.2f} m of what it was asked for, "
            f"{summary['rms_position_error_m']:.3f} m RMS."
        ],
        numbers=[
            page.Number(
                label="RMS distance from the target",
                value=f"{1e3 * summary['rms_position_error_m']:.0f}",
                unit="mm",
            ),
            page.Number(
                label="share of the time that a motor was saturated",
                value=f"{saturated:.1f}",
                unit="%",
                tone="good" if saturated < 1.0 else "fair",
            ),
            page.Number(label="charge left", value=f"{100 * summary['charge_left']:.0f}", unit="%"),
        ],
        sections=[
            page.Section(title="The flight", content=[moving_vehicle(log, design)]),
            page.Section(title="Curves", content=_curves(log)),
        ],
        held_fixed=[(str(k), str(v)) for k, v in log.metadata.items() if not isinstance(v, dict)],
    )


def moving_vehicle(log: FlightLog, design: Design | FlyingVehicle) -> Moving:
    """The vehicle along its flight; propellers turn twenty times slower than they do."""
    shapes = shapes_of(design)
    time = log.series("time")
    period = float(np.diff(time).mean()) if len(time) > 1 else 1.0
    kept = np.arange(0, len(time), max(1, round(1.0 / FRAME_RATE / period)))
    position = log.series("position")[kept]
    quaternion = log.series("quaternion")[kept]
    body = UP @ Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
    places = position @ UP
    angles = _angles(log, shapes)[kept]
    return Moving(
        time_s=time[kept],
        parts=[
            *_parts(shapes, body, places, angles),
            Line(name="path", color=COLORS["fitted"], points_m=places),
        ],
        caption="Drag to turn, wheel to zoom, Shift and drag to move, double click to begin anew. "
        f"Propellers turn {SLOWER:g} times slower than they do.",
    )


def _angles(log: FlightLog, shapes: FlightShapes) -> Array:
    """Angles of the propellers over time, counter-clockwise about their thrust, (T, n_rotors)."""
    thrusts, time = log.series("thrusts"), log.series("time")
    speeds = np.array(
        [
            [float(r.speed(float(u))) for r, u in zip(shapes.rotors, now, strict=True)]
            for now in thrusts
        ]
    )
    turned = np.cumsum(speeds * np.gradient(time)[:, None] if len(time) > 1 else speeds, axis=0)
    return -shapes.vehicle.spins.numpy() * turned / SLOWER


def _parts(shapes: FlightShapes, body: Array, places: Array, angles: Array) -> list[Rigid]:
    """The frame as one part, and each propeller."""
    import trimesh

    hubs, axes = shapes.vehicle.positions.numpy(), shapes.vehicle.directions.numpy()
    frame, out = [], []
    for name, mesh in shapes.meshes.items():
        shown = mesh if len(mesh.faces) <= _FEW else trimesh.convex.convex_hull(mesh)
        motor = name.removesuffix("__propeller")
        if motor not in shapes.rotor_names or name == motor:
            frame.append(shown)
            continue
        k = shapes.rotor_names.index(motor)
        spin = Rotation.from_rotvec(angles[:, k, None] * axes[k]).as_matrix()
        own = np.asarray(shown.vertices) - shapes.center_of_mass - hubs[k]
        out.append(_rigid("propellers", "third", shown, own, body @ spin, places + body @ hubs[k]))
    if frame:
        joined: Any = trimesh.util.concatenate(frame)
        own = np.asarray(joined.vertices) - shapes.center_of_mass
        out.insert(0, _rigid("frame", "measured_2", joined, own, body, places))
    return out


def _rigid(
    name: str, role: str, mesh: trimesh.Trimesh, nodes: Array, turns: Array, places: Array
) -> Rigid:
    return Rigid(
        name=name,
        color=COLORS[role],
        triangles=np.asarray(mesh.faces),
        nodes_m=nodes,
        turns=turns,
        places_m=places,
    )


def _curves(log: FlightLog) -> Sequence[page.Chart]:
    shown = slice(None, None, -(-len(log.samples) // _SAMPLES))
    time = log.series("time")[shown]
    up, asked = (log.series(name)[shown] @ UP for name in ("position", "target"))
    motors, voltage = log.series("pwm")[shown], log.series("voltage")[shown]
    figure = charts.grid(3, titles=["position [m]", "pulse width [us]", "voltage [V]"])
    for axis, name, color in zip(range(3), ("north", "west", "up"), CYCLE, strict=False):
        _add(figure, 1, charts.line(time, up[:, axis], name, color))
        dashed: Any = {"line": {"color": color, "width": 1.0, "dash": "dot"}}
        _add(figure, 1, charts.line(time, asked[:, axis], f"{name}, asked for", color, **dashed))
    for k, values in enumerate(motors.T):
        color = CYCLE[k % len(CYCLE)]
        _add(figure, 2, charts.line(time, values, f"motor {k + 1}", color))
    _add(figure, 3, charts.line(time, voltage, "battery", COLORS["measured_2"]))
    figure.update_xaxes(title_text="time [s]", row=3, col=1)
    figure.update_xaxes(matches="x")
    caption = "Drag to zoom, double click to zoom out; click a name to hide its curve."
    return [page.Chart(figure=figure, caption=caption)]


def _add(figure: Any, row: int, curve: Any) -> None:
    figure.add_trace(curve, row=row, col=1)
