"""The virtual laboratories as rigs: a beam, a multicopter, a network of channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from labs.rates.rig import Cause, Recorded, Size
from labs.rates.sheets import true_base
from labs.systems import setup_file
from labs.virtual.channel_network import NetworkLab
from labs.virtual.common import Lab
from labs.virtual.multicopter import CopterLab
from labs.virtual.soft_beam import SoftBeamLab

SIGNED = {"wind", "body_tilt", "center_of_mass", "tilt", "current", "temperature_drift",
          "sensor_scale", "tip_scale", "viscosity", "temperature_gradient", "pump_gain",
          "meter_gain", "pressure_offset", "pressure_scale", "accelerometer_scale",
          "gyro_offset", "thrust_curvature"}  # fmt: skip
ONE_PLACE = {"weak_rotor", "blocked_branch", "meter_gain", "pressure_offset"}
TROUBLES = ("heavy_tails", "spikes", "colored_noise", "gaps")  # decoys that are no cause


@dataclass(frozen=True)
class LabRig:
    """A virtual laboratory, diagnosed with the model of ``labs.systems``."""

    name: str  # of the laboratory, for its setup
    lab: type[Lab]  # class of the laboratory
    disturbances: tuple[str, ...] = TROUBLES

    @property
    def setup_file(self) -> Path | None:
        """File with the model."""
        return setup_file(self.name)

    @property
    def causes(self) -> Mapping[str, Cause]:
        """What it can hide; what is in no library among it."""
        return {
            name: Cause(
                effect.typical,
                name in SIGNED,
                effect.components,
                one_place=name in ONE_PLACE,
                known=not effect.outside,
            )
            for name, effect in self.lab.effects.items()
        }

    def record(self, seed: int, hidden: Mapping[str, Size], disturbance: str) -> Recorded:
        """A study of the laboratory, called after nothing that tells its seed."""
        decoys = (disturbance,) if disturbance else ()
        made = self.lab().case(seed, hidden, decoys)
        clean = self.lab().case(seed, hidden, decoys, noise=0.0).study
        runs = tuple(
            replace(exact, measured=np.where(np.isnan(run.measured), np.nan, exact.measured))
            for exact, run in zip(clean.runs, made.study.runs, strict=True)
        )
        study = replace(made.study, name=self.name)
        base = true_base(self.lab.base, made.truth)
        return Recorded(study, replace(study, runs=runs), base)


BEAM = (LabRig("beam", SoftBeamLab),)
FLIGHT = (LabRig("copter", CopterLab),)
NETWORK = (LabRig("network", NetworkLab),)
