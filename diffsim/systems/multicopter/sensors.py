"""Causes in what the sensors of a multicopter show."""

from __future__ import annotations

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.scene import CopterScene, amount, vector


class MarkerPlacement(Effect):
    """The captured point lies at size in the body frame instead of the centre of mass."""

    name, family, kind, unit, typical = "placement", "sensor", "sensor", "m", 5e-3
    components = ("x", "y", "z")
    also_looks_like = ("body origin of the capture system",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        return scene.changed(marker=scene.marker + vector(size))


class ImuTilt(Effect):
    """Gyro and accelerometer sit turned by size, a small rotation vector in the body frame."""

    name, family, kind, unit, typical = "sensor_tilt", "sensor", "sensor", "rad", 0.02
    components = ("x", "y", "z")
    also_looks_like = ("body tilt, if only the accelerometer is seen",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        return scene.changed(imu_tilt=scene.imu_tilt + vector(size))


class PositionScale(Effect):
    """The captured position is larger by the share size."""

    name, family, kind, unit, typical = "sensor_scale", "sensor", "sensor", "-", 0.02
    also_looks_like = ("thrust gain and mass in vertical flight",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        return scene.changed(position_scale=scene.position_scale * (1.0 + amount(size, 0)))


class AccelerometerScale(Effect):
    """The accelerometer shows 1 + size times what is there."""

    name, family, kind, unit, typical = "accelerometer_scale", "sensor", "sensor", "-", 0.02
    also_looks_like = ("mass with the thrust gain",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        scale = scene.accelerometer_scale * (1.0 + amount(size, 0))
        return scene.changed(accelerometer_scale=scale)


class GyroOffset(Effect):
    """The gyro shows size more."""

    name, family, kind, unit, typical = "gyro_offset", "sensor", "sensor", "rad/s", 0.02
    components = ("x", "y", "z")
    also_looks_like = ("warming gyro",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        return scene.changed(body_rates_offset=scene.body_rates_offset + vector(size))
