"""Causes of soft bodies by name, for models that no study describes."""

from functools import partial

from diffsim.causes.catalogue import rows
from diffsim.causes.commands import CommandGroup, cause_of_commands
from diffsim.causes.ports import on_clock, on_readings
from diffsim.systems.soft_body.causes import FUNCTIONS
from diffsim.systems.soft_body.support import move_support
from labs.systems.beam_causes import body_cause

PULL_M = 0.03  # greatest command
_PULLED = CommandGroup((), dict.fromkeys(("reach", "width", "rate"), PULL_M))
_SENSOR = rows("sensor")
_OF_PARTS = ("tip_mass", "load_inertia", "slack_string", "body_scale")
_OF_ANY = ("stiffness_damping", *(name for name in FUNCTIONS if name not in _OF_PARTS))
ANY_BODY = (
    *(body_cause(name) for name in _OF_ANY),
    body_cause("support_motion", apply=partial(move_support, names=("support_x_m", "support_z_m"))),
    *(cause_of_commands(row, _PULLED) for row in rows("actuator").values()),
    _SENSOR["sensor_delay"].effect(on_clock(())),
    _SENSOR["sensor_scale"].effect(on_readings(_SENSOR["sensor_scale"], ())),
    body_cause("clock_rate"),
)
CAUSES = {e.name: e for e in (*ANY_BODY, body_cause("slack_string", {"fall": 0.01}))}
