"""Virtual laboratories: studies with causes hidden in them, for trying out a diagnosis.

They share no code with the simulators that are diagnosed: other equations, other integrators,
sharp instead of smoothed nonlinearities. What they make is never measured data, and its metadata
say so (``virtual: true``).
"""

from __future__ import annotations

from labs.virtual.channel_network import NetworkLab
from labs.virtual.common import DECOYS, Lab, LabCase, LabEffect
from labs.virtual.multicopter import CopterLab
from labs.virtual.soft_beam import SoftBeamLab

#: By system.
LABS: dict[str, type[Lab]] = {
    "soft_body": SoftBeamLab,
    "copter": CopterLab,
    "stokes": NetworkLab,
}

__all__ = [
    "DECOYS",
    "LABS",
    "CopterLab",
    "Lab",
    "LabCase",
    "LabEffect",
    "NetworkLab",
    "SoftBeamLab",
]
