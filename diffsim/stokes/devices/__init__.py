"""The six fluidic devices of thesis table 4.5, and the search for their designs.

    >>> from diffsim.stokes import devices
    >>> device = devices.make("amplifier", resolution=0.5)
    >>> best = devices.optimize(device)
    >>> flow = device.solve(best.x)

On the command line: ``diffsim devices amplifier --out runs/amplifier``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from diffsim.core import plugins
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.plugins import find_plugins, load_plugin
from diffsim.stokes.devices.amplifier import amplifier
from diffsim.stokes.devices.averager import averager
from diffsim.stokes.devices.coarse_to_fine import coarse_to_fine
from diffsim.stokes.devices.device import Device, Parameter, State
from diffsim.stokes.devices.funnel import funnel
from diffsim.stokes.devices.gate import gate
from diffsim.stokes.devices.losses import area, mean_velocity
from diffsim.stokes.devices.optimize import optimize
from diffsim.stokes.devices.optimum import CoarseStage, Optimum
from diffsim.stokes.devices.switch import switch
from diffsim.stokes.devices.twister import twister

DEVICES: dict[str, Callable[..., Device]] = {
    "amplifier": amplifier,
    "averager": averager,
    "funnel": funnel,
    "gate": gate,
    "twister": twister,
    "switch": switch,
}
"""Name to maker."""


@checked
def make(name: str, resolution: float = 1.0, **options: object) -> Device:
    """A device by name: one of ``DEVICES``, or of another package's.

    Packages of users add devices by entry points of the group ``diffsim.devices``: functions
    (resolution, **options) -> Device.

    Args:
        name: Name of the device.
        resolution: Factor on the number of cells per axis; 1 is the thesis's grid.
        **options: Options of the device, such as ``wall`` of the twister.
    """
    added = find_plugins(plugins.DEVICES)
    require_choice("name", name, (*DEVICES, *added))
    maker = DEVICES[name] if name in DEVICES else load_plugin(plugins.DEVICES, name, object)
    device: Device = maker(resolution, **options)
    return replace(device, remake=partial(make, name, resolution, **options))


__all__ = [
    "DEVICES",
    "CoarseStage",
    "Device",
    "Optimum",
    "Parameter",
    "State",
    "amplifier",
    "area",
    "averager",
    "coarse_to_fine",
    "funnel",
    "gate",
    "make",
    "mean_velocity",
    "optimize",
    "switch",
    "twister",
]
