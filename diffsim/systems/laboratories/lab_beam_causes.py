"""Causes for the laboratory's beam, their sizes in the laboratory's units.

Drag per volume instead of per surface, a backlash by its full width, a tilt of one component, and
stiffening by the strain of a place instead of the body's mean: otherwise a right size would be
counted as wrong.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems import actuator
from diffsim.systems.soft_body import forces, material, sensor
from diffsim.systems.soft_body.scene import SoftScene

# Bending: the mean of strain^4 over the section is 9/5 of the square of the mean of strain^2.
STRAIN4 = 9.0 / 5.0


class _PerVolume:
    """Drag of every node by its volume."""

    def shares(self, scene: SoftScene) -> Tensor:
        """(num_vertices,) [m^3]."""
        return scene.body.nodal_volume


class LinearDrag(_PerVolume, forces.LinearDrag):
    """Force per volume -size v."""

    unit, typical = "N s/m^4", 1e3


class QuadraticDrag(_PerVolume, forces.QuadraticDrag):
    """Force per volume -size |v| v."""

    unit, typical = "N s^2/m^5", 1.5e4


class Stiffening(material.Stiffening):
    """Stress E (1 + size strain^2) strain, under bending of one curvature."""

    typical = 400.0

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return super().apply(scene, STRAIN4 * size, run)


class SidewaysTilt(Effect):
    """A constant acceleration sideways."""

    name, family, kind, unit, typical = "tilt", "gravity", "environment", "m/s^2", 0.1
    also_looks_like = ("a bent rest shape",)

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        sideways = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        return scene.with_parameter("gravity", scene.parameter("gravity") + size[0] * sideways)


class DryFriction(forces.DryFriction):
    """At the tip."""

    typical = 5e-4
    slip_speed = 2e-3  # a twentieth of what the tip does


class AddedMass(forces.AddedMass):
    """Of water, per displaced mass."""

    typical = 0.05


class LossFactor(material.LossFactor):
    """As for the foam."""

    typical = 0.03


class Delay(actuator.CommandDelay):
    """Of the tension; it cannot be early."""

    typical, signed = 0.006, False


class Lag(actuator.Lag):
    """Of the tension."""

    typical = 0.006


class DeadBand(actuator.DeadBand):
    """Of the tension."""

    unit, typical = "N", 0.04


class Backlash(actuator.Backlash):
    """Of the tension, full width."""

    unit, typical = "N", 0.05

    def apply(self, scene: actuator.Commanded, size: Tensor, run: Run) -> Any:
        return super().apply(scene, 0.5 * size, run)


class TemperatureDrift(material.TemperatureDrift):
    """As of a room over an afternoon."""

    typical = 0.003


class TensionLimit(actuator.ActuatorEffect):
    """The drive gives (1 - size) of its largest tension, and no more."""

    name, family, unit, typical, signed = "saturation", "shape", "-", 0.1, False
    smooth = False
    also_looks_like = ("gain, if all commands reach as high", "stiffening")

    def __init__(self, largest_N: float):
        self._largest = largest_N

    def needs(self, study: Study) -> str | None:
        top = max(float(run.command["tendon_N"].max()) for run in study.fit_runs)
        if top < (1.0 - self.typical) * self._largest:
            return (
                f"a tension near {self._largest:g} N; the largest that was commanded is {top:g} N"
            )
        return super().needs(study)

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.with_command(
            lambda u, dt: torch.minimum(u, (1.0 - size[0]) * self._largest * torch.ones_like(u))
        )


class SensorScale(sensor.SensorScale):
    """As of a camera at a distance that is known to a few per cent."""

    typical = 0.06


class TipScale(Effect):
    """The tip's channel is larger by the share size; the other is not."""

    name, family, kind, unit, typical = "tip_scale", "sensor", "sensor", "-", 0.06
    also_looks_like = ("lens", "slipped marker", "mode shape")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        first = torch.eye(len(scene.axes), dtype=torch.float64)[0]
        return scene.with_output(lambda y, t: y * (1.0 + size[0] * first))


def causes(largest_N: float) -> tuple[Effect, ...]:
    """Candidates.

    Left out: what is a base parameter (stiffness-proportional damping, placement), what the
    laboratory has no channels for (tilt and lens of cameras), a current without known drag, and
    steps of the tension (quantisation), for which there is no term.

    Args:
        largest_N: What the drive can pull.
    """
    return (
        LossFactor(),
        Stiffening(),
        material.StiffnessLoss(),
        TemperatureDrift(),
        LinearDrag(),
        QuadraticDrag(),
        AddedMass(),
        SidewaysTilt(),
        DryFriction(),
        Delay(),
        Lag(),
        DeadBand(),
        Backlash(),
        TensionLimit(largest_N),
        SensorScale(),
        TipScale(),
    )
