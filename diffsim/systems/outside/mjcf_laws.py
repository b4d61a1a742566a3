"""Forces of causes that MuJoCo has itself: a number of the joint holds them.

A force that Python adds at each step is explicit. Dry friction is then viscous at low speed, where
a joint creeps that should stick, and only fine steps bear it. MuJoCo's own friction is a
constraint: it sticks, at the file's own step, and its own loop simulates it. The 20 ms in which it
takes hold where a file says nothing are of no joint: a pendulum creeps before it swings, and 3 mrad
of that stay to the end of 8 s. How soon friction that the file lacks takes hold is fitted.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cache
from typing import Any

from diffsim.causes.catalogue import rows
from diffsim.systems.outside.forces import PlaceForces
from diffsim.systems.outside.mjcf_numbers import Numbers

#: Numbers of a joint that are a cause at it, by the cause; each grows by the cause's size
OWN_LAWS = {
    "viscous_friction": "damping",
    "dry_friction": "frictionloss",
    "added_spring": "stiffness",
    "square_drag": "dampingpoly[0]",
    "cubic_stiffness": "stiffnesspoly[1]",
}
HOLD_STEPS = 2.0  # in which friction takes hold at least: MuJoCo itself takes no fewer
HOLDS_S = (1e-3, 0.02)  # as of a joint; where a file says nothing
SIGNED = ("cubic_stiffness",)  # numbers that may be negative
#: What a file may switch off, so that the number does nothing, by versions of MuJoCo
_SWITCHES = {
    "damping": ("mjDSBL_DAMPER", "mjDSBL_PASSIVE"),
    "frictionloss": ("mjDSBL_FRICTIONLOSS", "mjDSBL_CONSTRAINT"),
    "stiffness": ("mjDSBL_SPRING", "mjDSBL_PASSIVE"),
    "dampingpoly[0]": ("mjDSBL_DAMPER", "mjDSBL_PASSIVE"),
    "stiffnesspoly[1]": ("mjDSBL_SPRING", "mjDSBL_PASSIVE"),
}


@cache
def _by_formula() -> Mapping[str, str]:
    """The causes by their formulas."""
    return {rows("force")[law].said("law"): law for law in OWN_LAWS}


def path_of_law(mujoco: Any, numbers: Numbers, law: str, joint: str) -> str | None:
    """The number that is a cause at a joint; None: MuJoCo has none, or not there."""
    what = OWN_LAWS.get(law)
    if what is None:
        return None
    plain, index = numbers.plain, numbers.find("joint", joint, "hooks.force")
    flags = (getattr(mujoco.mjtDisableBit, name, 0) for name in _SWITCHES[what])
    is_off = any(int(plain.opt.disableflags) & int(flag) for flag in flags)
    # a cause pushes back to position 0, a spring to its own rest
    is_spring, is_there = what.startswith("stiffness"), numbers.has(what)
    is_bent = is_spring and plain.qpos_spring[plain.jnt_qposadr[index]] != 0.0
    if is_off or is_bent or not is_there or numbers.num_axes(index) > 1:
        return None
    return f"joint.{joint}.{what}"


def hold_of(numbers: Numbers, parameters: Collection[str], path: str) -> str | None:
    """The number that says how soon friction takes hold; None: not friction, or somebody said it.

    Where a file or a study has friction, or another softness than MuJoCo's usual, that stays.

    Args:
        parameters: Paths that a study states.
        path: Number that a cause adds to.
    """
    joint, _, what = path.rpartition(".")
    hold = f"{joint}.solreffriction"
    if what != OWN_LAWS["dry_friction"] or path in parameters or hold in parameters:
        return None
    is_new = numbers.value_of(path) == 0.0 and numbers.value_of(hold) == HOLDS_S[1]
    return hold if is_new else None


def with_hold(
    numbers: Numbers, parameters: Collection[str], path: str, share: float
) -> dict[str, float]:
    """How soon friction takes hold that a cause brings to a joint, by path; empty where it is said.

    Args:
        parameters: Paths that a study states.
        path: Number that a cause adds to.
        share: Of the way between ``HOLDS_S``, by ratios, as far as the file's own steps allow.
    """
    hold = hold_of(numbers, parameters, path)
    if hold is None:
        return {}
    soonest = max(HOLDS_S[0], HOLD_STEPS * float(numbers.plain.opt.timestep))
    softest = max(soonest, HOLDS_S[1])
    return {hold: soonest * (softest / soonest) ** share}


def take_own(
    mujoco: Any, numbers: Numbers, parameters: Mapping[str, float], force: PlaceForces | None
) -> tuple[dict[str, float], PlaceForces | None]:
    """Parameters with the forces that MuJoCo has itself, and the forces that are left.

    A size that would make a number negative is left to Python.

    Args:
        parameters: Values by path.
    """
    out = dict(parameters)
    if force is None or not force.acts:
        return out, force
    taken = []
    for term in force.terms:
        law = _by_formula().get(getattr(term.law, "text", ""), "")
        path = path_of_law(mujoco, numbers, law, term.place)
        if path is not None:
            value = out.get(path, numbers.value_of(path)) + term.size
            if value >= 0.0 or law in SIGNED:
                out[path] = value
                share = term.shapes[0] if term.shapes else 1.0
                out |= with_hold(numbers, parameters, path, share)
                taken.append(term)
    return out, force.without(taken) if taken else force
