"""Simulators with the hooks that candidate causes need: soft bodies and multicopters."""

from diffsim.diagnose.beds.copter import CopterScene
from diffsim.diagnose.beds.copter_model import CopterModel, flight_model
from diffsim.diagnose.beds.soft import SoftScene
from diffsim.diagnose.beds.soft_models import beam_model, tendon_model

__all__ = [
    "CopterModel",
    "CopterScene",
    "SoftScene",
    "beam_model",
    "flight_model",
    "tendon_model",
]
