"""Which adapters join which pair of patches: the rule table of thesis 3.2.2."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from diffsim.copter.vehicle.patches import Patch
from diffsim.core.arrays import Array

# (fitting, fitting) in alphabetical order -> adapters from the first to the second
RULES: dict[tuple[str, str], tuple[str, ...]] = {
    ("rod", "rod"): ("round_connector", "round_connector"),
    ("plate", "rod"): ("round_connector",),
    ("motor", "rod"): ("round_connector",),
    ("rod", "strap"): ("round_connector",),
    ("plate", "plate"): ("screw_mount",),
    ("plate", "strap"): (),
    ("strap", "strap"): (),
    ("motor", "plate"): (),
    ("mount", "plate"): (),
    ("mount", "mount"): (),
    ("mount", "strap"): (),
    ("motor", "mount"): (),
    ("shaft", "shaft"): (),
}
ADAPTERS = {"standoff", *(kind for kinds in RULES.values() for kind in kinds)}


def adapters_for(host: Patch, guest: Patch) -> tuple[str, ...]:
    """Kinds of the adapters between two patches, from host to guest.

    A rod on a mount slides into its bore, or gets a connector of its own on a flat face.

    Raises:
        ValueError: no rule joins the pair.
    """
    fittings = {host.fitting, guest.fitting}
    if fittings == {"mount", "rod"}:
        mount = host if host.fitting == "mount" else guest
        return () if mount.shape == "circular" else ("round_connector",)
    pair = (min(host.fitting, guest.fitting), max(host.fitting, guest.fitting))
    if pair not in RULES:
        fits = sorted({*pair_partners(host.fitting)})
        raise ValueError(
            f"no adapter joins a {host.fitting} patch and a {guest.fitting} patch; a "
            f"{host.fitting} patch takes {', '.join(fits) or 'nothing'}"
        )
    adapters = RULES[pair]
    return adapters if host.fitting == pair[0] else adapters[::-1]


Candidate = tuple[str, str, Patch, Array]  # part, patch's name, patch, where it is (3,) [m]


def closest_pair(
    hosts: Sequence[Candidate], guests: Sequence[Candidate]
) -> tuple[Candidate, Candidate]:
    """The two closest patches that some rule joins (thesis 3.2.2).

    Raises:
        ValueError: no rule joins any pair.
    """
    pairs = list(itertools.product(hosts, guests))
    fitting = [(a, b) for a, b in pairs if b[2].fitting in pair_partners(a[2].fitting)]
    if not fitting:
        host, guest = pairs[0]
        adapters_for(host[2], guest[2])  # says why
    return min(fitting, key=lambda pair: float(np.linalg.norm(pair[0][3] - pair[1][3])))


def pair_partners(fitting: str) -> set[str]:
    """Fittings that some rule joins to this one."""
    partners = {b if a == fitting else a for a, b in RULES if fitting in (a, b)}
    partners |= {"mount"} if fitting == "rod" else {"rod"} if fitting == "mount" else set()
    return partners


def ports(names: Sequence[str], host_shape: str, next_shape: str) -> tuple[str, str]:
    """Patches of an adapter that face its host and what follows.

    Args:
        names: Names of the adapter's patches.
        host_shape, next_shape: "circular" or "flat".
    """
    if "bore" not in names:
        return "bottom", "top"
    entry = "bore" if host_shape == "circular" else "bottom"
    return entry, "bore" if next_shape == "circular" and entry != "bore" else "top"
