"""Causes in what the sensors of a multicopter show."""

from __future__ import annotations

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.estimator import BlindEstimator
from diffsim.systems.multicopter.scene import CopterScene, amount, vector


def _marker_placement(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.changed(marker=scene.marker + vector(size))


def _imu_tilt(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.changed(imu_tilt=scene.imu_tilt + vector(size))


def _position_scale(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.changed(position_scale=scene.position_scale * (1.0 + amount(size, 0)))


def _ground_scale(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.changed(ground_scale=scene.ground_scale * (1.0 + amount(size, 0)))


def _accelerometer_scale(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    scale = scene.accelerometer_scale * (1.0 + amount(size, 0))
    return scene.changed(accelerometer_scale=scale)


def _gyro_offset(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.changed(body_rates_offset=scene.body_rates_offset + vector(size))


def _camera_delay(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    before = 0.0 if scene.camera_delay is None else scene.camera_delay
    return scene.changed(camera_delay=before + amount(size, 0))


def _blind_estimator(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    assert scene.estimator_gains is not None
    drag, record = amount(size, 0), scene.windows
    points = max(len(drag), len(scene.estimator_gains))
    known = drag.expand(points), scene.estimator_gains.expand(points, -1)
    force = scene.force_by_record()
    blind = BlindEstimator.of(record.states, record.acceleration, force, scene.dt, known)
    return scene.changed(estimator=blind)


BLIND_ESTIMATOR = Effect(
    name="blind_estimator",
    form="Velocity and attitude are those of an estimator that lacks drag, size v per mass: "
    "velocity is too large by e, attitude turned by d, e' = d x f + size v - a e, "
    "d' = -(b, b, c) (f x e).",
    family="sensor",
    kind="sensor",
    unit="1/s",
    typical=0.3,
    signed=False,
    also_looks_like=("positions along the ground that are short", "a bias of the attitude"),
    apply=_blind_estimator,
)
MARKER_PLACEMENT = Effect(
    name="placement",
    form="The captured point lies at size in the body frame instead of the center of mass.",
    family="sensor",
    kind="sensor",
    unit="m",
    typical=0.005,
    components=("x", "y", "z"),
    also_looks_like=("body origin of the capture system",),
    apply=_marker_placement,
)
IMU_TILT = Effect(
    name="sensor_tilt",
    form="Gyro and accelerometer sit turned by size, a small rotation vector in the body frame.",
    family="sensor",
    kind="sensor",
    unit="rad",
    typical=0.02,
    components=("x", "y", "z"),
    also_looks_like=("body tilt, if only the accelerometer is seen",),
    apply=_imu_tilt,
)
GROUND_SCALE = Effect(
    name="ground_scale",
    form="Positions along the ground are shown 1 + size times the true ones; heights are right.",
    family="sensor",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.02,
    also_looks_like=("velocities along the ground that are shown too large or small",),
    apply=_ground_scale,
)
POSITION_SCALE = Effect(
    name="sensor_scale",
    form="The captured position is larger by the share size.",
    family="sensor",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.02,
    also_looks_like=("thrust gain and mass in vertical flight",),
    apply=_position_scale,
)
ACCELEROMETER_SCALE = Effect(
    name="accelerometer_scale",
    form="The accelerometer shows 1 + size times what is there.",
    family="sensor",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.02,
    also_looks_like=("mass with the thrust gain",),
    apply=_accelerometer_scale,
)
GYRO_OFFSET = Effect(
    name="gyro_offset",
    form="The gyro shows size more.",
    family="sensor",
    kind="sensor",
    unit="rad/s",
    typical=0.02,
    components=("x", "y", "z"),
    also_looks_like=("warming gyro",),
    apply=_gyro_offset,
)
CAMERA_DELAY = Effect(
    name="camera_delay",
    form="Position, velocity and attitude show what was size ago; gyro and accelerometer do not.",
    family="timing",
    kind="sensor",
    unit="s",
    typical=0.02,
    signed=False,
    also_looks_like=("filter of a motion capture", "clock of the cameras"),
    apply=_camera_delay,
)
