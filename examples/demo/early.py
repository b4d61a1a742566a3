"""Results on the screen as soon as they are there; the page follows at the end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def measured(sag_m: float, apart_m: float) -> str:
    """What the recordings show.

    Args:
        sag_m: How far the tip hangs below its unstrained place [m].
        apart_m: How far repeats are apart, root mean square [m].
    """
    return (
        f"measured   the tip sags by {1e3 * abs(sag_m):.2f} mm; repeats of its swing differ by "
        f"{1e3 * apart_m:.2f} mm"
    )


def stiffness(youngs_modulus_pa: float, published_pa: float) -> str:
    """Young's modulus that gives the measured sag on this mesh, beside the published one."""
    return (
        f"stiffness  E = {1e-6 * youngs_modulus_pa:.3f} MPa gives that sag on this mesh; "
        f"published: {1e-6 * published_pa:.3f} MPa"
    )


def fitted(what: str, value: Mapping[str, Any]) -> str:
    """Parameters of a fit to motion, in SI units."""
    numbers = ", ".join(f"{name} {float(number):.4g}" for name, number in value.items())
    return f"motion     {what}: {numbers}"
