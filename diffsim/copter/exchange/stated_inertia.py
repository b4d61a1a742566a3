"""Mass and moments of inertia of URDF's links and MJCF's bodies: refused where impossible."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from diffsim.core.inertia import ENTRIES, inertia_mistake, mass_mistake

_DIAGONAL = tuple(f"diaginertia[{k}]" for k in range(3))
_FULL = tuple(f"{name} (fullinertia[{k}])" for k, name in enumerate(ENTRIES))


def refuse_impossible_inertia(root: Element, compiler: dict[str, str] | None = None) -> None:
    """Refuse inertia that no body has, by the name of its link or body.

    Args:
        root: Of an MJCF or URDF file, included files in their places.
        compiler: Attributes of MJCF's ``<compiler>``: what it balances or computes is not asked.

    Raises:
        ValueError: with the entry, what must hold of it, and the likely slip.
    """
    stated = compiler or {}
    if stated.get("inertiafromgeom") == "true":
        return
    triangle = stated.get("balanceinertia") != "true"
    for owner in root.iter():
        inertial = owner.find("inertial") if owner.tag in ("link", "body") else None
        if inertial is None:
            continue
        try:
            mass, entries, names = _read_inertial(inertial)
        except ValueError:
            continue  # not a number: MuJoCo names it
        named = dict(zip(names, entries, strict=True))
        said = None if mass is None else mass_mistake(mass, named)
        if said is None and any(entries):
            said = inertia_mistake(entries, names, triangle=triangle)
        if said is not None:
            raise ValueError(f"{owner.tag} {owner.get('name', 'without a name')!r}: {said}")


def _read_inertial(inertial: Element) -> tuple[float | None, tuple[float, ...], tuple[str, ...]]:
    """Mass, six entries and their names in the file; zeros where nothing is stated."""
    weighs, tensor = inertial.find("mass"), inertial.find("inertia")
    mass = inertial.get("mass") if weighs is None else weighs.get("value")
    if tensor is not None:
        return _number(mass), tuple(float(tensor.get(e, "0")) for e in ENTRIES), ENTRIES
    diagonal = [float(x) for x in inertial.get("diaginertia", "").split()]
    if len(diagonal) == 3:
        return _number(mass), (*diagonal, 0.0, 0.0, 0.0), (*_DIAGONAL, *ENTRIES[3:])
    full = [float(x) for x in inertial.get("fullinertia", "").split()]
    return _number(mass), tuple(full) if len(full) == 6 else (0.0,) * 6, _FULL


def _number(text: str | None) -> float | None:
    return None if text is None else float(text)
