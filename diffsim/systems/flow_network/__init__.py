"""Networks of channels with steady flow, by resistances or on the Stokes simulator.

The flow is steady at every sample, so a run is a sequence of drive levels. Flows of a manifold are
per depth (m^2/s), as everywhere in two dimensions.
"""

from diffsim.systems.flow_network.device import ChannelDevice, Opening
from diffsim.systems.flow_network.network import NetworkDevice, Segment

__all__ = ["ChannelDevice", "NetworkDevice", "Opening", "Segment"]
