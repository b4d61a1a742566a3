"""Whether mass and moments of inertia can be those of a body, said by the entries of a file.

Moments of inertia are integrals of squared distances: each is positive, none is above the sum of
the two others, and their matrix is positive definite. What breaks this is a slip of the file, of a
few kinds: a sign, a power of ten, entries in each other's slots, another unit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from diffsim.core.arrays import Array

ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_PAIRS = ((0, 1), (0, 2), (1, 2))
#: Files state two or three digits, and a plate has the sum: 0.011 + 0.012 may be called 0.0235.
ROUNDING = 0.02
#: Radius of gyration over the reach of the rotors, which are a part of the mass themselves. It is
#: 0.1 to 0.6 in flown copters; the least slip of a unit, g for kg, moves it by 32.
LEAST_GYRATION, LARGEST_GYRATION = 1.0 / 20.0, 5.0
_UNITS = {1e9: "g mm^2", 1e7: "g cm^2", 1e6: "kg mm^2", 1e4: "kg cm^2", 1e3: "g m^2"}


def inertia_matrix(entries: Sequence[float]) -> Array:
    """The matrix (3, 3) of xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def entries_of_matrix(given: Any) -> Any:
    """What a user states, with three rows of three as their six entries; all else as it is.

    Args:
        given: As YAML reads it.

    Raises:
        ValueError: two entries that are one number differ.
    """
    if not isinstance(given, list | tuple) or len(given) != 3:
        return given
    if not all(isinstance(row, list | tuple) and len(row) == 3 for row in given):
        return given
    for i, k in _PAIRS:
        if given[i][k] != given[k][i]:
            raise ValueError(
                f"row {i + 1}, column {k + 1} must equal row {k + 1}, column {i + 1}, got "
                f"{given[i][k]!r} and {given[k][i]!r}: a matrix of inertia is symmetric"
            )
    return [*(given[k][k] for k in range(3)), *(given[i][k] for i, k in _PAIRS)]


def inertia_mistake(
    entries: Sequence[float], names: Sequence[str] = ENTRIES, *, triangle: bool = True
) -> str | None:
    """What no body has, with the likely slip; None where nothing is wrong.

    Args:
        entries: xx, yy, zz, xy, xz, yz about the center of mass [kg m^2].
        names: What the file calls them.
        triangle: Whether the moments must keep the triangle inequality.
    """
    moments = np.asarray(entries[:3], dtype=np.float64)
    for name, value in zip(names, entries, strict=True):
        if not math.isfinite(value):
            return f"{name} must be finite, got {value:g}"
    for k in range(3):
        if not moments[k] > 0.0:
            others = float(np.abs(np.delete(moments, k)).max())
            far = others > 0.0 and abs(moments[k]) > 100.0 * others
            slip = "another entry's slot, or a power of ten" if far else "a sign, or an entry left"
            return f"{names[k]} must be above 0, got {moments[k]:.6g}: {slip}?"
    for k, (i, j) in enumerate(_PAIRS):
        product, most = entries[3 + k], math.sqrt(moments[i] * moments[j])
        if not abs(product) < most:
            return (
                f"{names[3 + k]} must lie within {most:.4g}, the root of {names[i]} {names[j]}, "
                f"got {product:.6g}: entries in each other's slots?"
            )
    if triangle and (said := _broken_triangle(moments, names)):
        return said
    principal = np.linalg.eigvalsh(inertia_matrix(entries))
    if not principal[0] > 0.0:
        return (
            f"the principal moments must be above 0, got {_list_values(principal)} kg m^2 of "
            f"{', '.join(names)}: entries in each other's slots, or their signs?"
        )
    if triangle and principal[2] > (1.0 + ROUNDING) * (principal[0] + principal[1]):
        return (
            f"none of the principal moments may be above the sum of the others, got "
            f"{_list_values(principal)} kg m^2 of {', '.join(names)}: the signs of products, or a "
            "power of ten?"
        )
    return None


def size_mistake(mass: float, inertia: Array, reach: float) -> str | None:
    """A radius of gyration that is far from the size of the body; None where it may be right.

    Args:
        mass: Mass [kg].
        inertia: About the center of mass, (3, 3) [kg m^2].
        reach: Distance of the farthest tip of a rotor from the center of mass [m].
    """
    gyration = math.sqrt(0.5 * float(np.trace(inertia)) / mass)
    if LEAST_GYRATION * reach <= gyration <= LARGEST_GYRATION * reach:
        return None
    factor = (gyration / (0.3 * reach)) ** 2  # 0.3: the middle of flown copters
    if factor > 1.0:
        unit = min(_UNITS, key=lambda k: abs(math.log(factor / k)))
        slip = f"are they {_UNITS[unit]}, {unit:g} of which are a kg m^2?"
    else:
        slip = "is the mass in g?"
    return (
        f"mass {mass:.4g} kg and inertia {_list_values(np.diag(inertia))} kg m^2 make a radius of "
        f"gyration of {gyration:.3g} m, and the rotors reach {reach:.3g} m: {slip}"
    )


def mass_mistake(mass: float, entries: Mapping[str, float]) -> str | None:
    """A mass that no body with these moments of inertia has; None where nothing is wrong."""
    if not math.isfinite(mass) or mass < 0.0:
        return f"mass must be finite and at least 0, got {mass:g}"
    if mass == 0.0 and any(entries.values()):
        return "mass must be above 0 where moments of inertia are, got 0"
    return None


def _broken_triangle(moments: Array, names: Sequence[str]) -> str | None:
    k = int(np.argmax(moments))
    rest = [i for i in range(3) if i != k]
    most = float(moments[rest].sum())
    if moments[k] <= (1.0 + ROUNDING) * most:
        return None
    ratio = 2.0 * moments[k] / most
    least = int(np.argmin(moments))
    if ratio > 30.0:
        slip = f"it is {10.0 ** round(math.log10(ratio)):g} times the others: another unit"
    elif moments[k] <= 1.1 * most + 9.9 * moments[least]:
        slip = f"{names[least]} ten times as large would fit: a power of ten"
    else:
        slip = "another entry's slot"
    a, b = (names[i] for i in rest)
    return f"{names[k]} must be at most {a} + {b} = {most:.4g}, got {moments[k]:.6g}; {slip}?"


def _list_values(values: Iterable[float]) -> str:
    return ", ".join(f"{v:.4g}" for v in values)
