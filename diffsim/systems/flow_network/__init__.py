"""The flow device: a planar channel network on the Stokes simulator, and what real ones add to it.

The flow is steady at every sample, so a run is a sequence of drive levels. Flows are per depth
(m^2/s), as everywhere in two dimensions.
"""

from diffsim.systems.flow_network.causes import network_library, stokes_library
from diffsim.systems.flow_network.device import ChannelDevice, Opening
from diffsim.systems.flow_network.model import StokesScene, device_base, device_model
from diffsim.systems.flow_network.network import NetworkDevice, Segment
from diffsim.systems.flow_network.network_model import NetworkScene, network_base, network_model

__all__ = [
    "ChannelDevice",
    "NetworkDevice",
    "NetworkScene",
    "Opening",
    "Segment",
    "StokesScene",
    "device_base",
    "device_model",
    "network_base",
    "network_library",
    "network_model",
    "stokes_library",
]
