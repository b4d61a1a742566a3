"""Do the numbers of a body look like meters, pascal and kilograms per cubic meter?"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from diffsim.core.numbers import values_of
from diffsim.core.record import warn

# What soft robots and their test pieces are not: outside of these, a unit was usually forgotten.
SIZES = (1e-4, 30.0)  # longest side [m]
MODULI = (50.0, 5e12)  # [Pa]; agar gels have 1 kPa, diamond 1 TPa
DENSITIES = (0.5, 3e4)  # [kg/m^3]; foams have 10, osmium 22,600


class UnitsWarning(UserWarning):
    """A number of a body lies where its unit has usually been forgotten."""


def warn_of_units(x_rest: Tensor, youngs_modulus: Tensor, density: Tensor) -> None:
    """Warn once of all that looks like another unit; the body is made all the same.

    Args:
        x_rest: Nodes at rest, (n_nodes, 3) [m].
        youngs_modulus: () or (n_elements,) [Pa].
        density: () or (n_elements,) [kg/m^3]; zero is no mistake: masses may be attached.
    """
    said = list(_doubts(values_of(x_rest), values_of(youngs_modulus), values_of(density)))
    if said:
        warn(
            "check the units (meters, pascal, kg/m^3): " + "; ".join(said),
            UnitsWarning,
            stacklevel=3,
        )


def _doubts(x_rest: Tensor, modulus: Tensor, density: Tensor) -> Iterator[str]:
    length = float((x_rest.amax(0) - x_rest.amin(0)).max())
    if not SIZES[0] <= length <= SIZES[1]:
        yield f"the body is {length:g} m long; nodes in millimeters times 1e-3 are meters"
    for name, values, (low, high), unit, hint in (
        ("youngs_modulus", modulus, MODULI, "Pa", "1 MPa is 1e6"),
        ("density", density, DENSITIES, "kg/m^3", "1 g/cm^3 is 1000"),
    ):
        odd = values[((values < low) & (values > 0.0)) | (values > high)]
        if torch.numel(odd):
            yield f"{name} is {float(odd.flatten()[0]):g} {unit}; {hint}"
