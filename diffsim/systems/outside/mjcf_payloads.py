"""Payloads of the bodies of a MuJoCo model: which may carry one, where, and what that changes.

A payload is a point mass on the line from a body's joint through its center of mass. It changes
the torque of gravity and the inertia otherwise than a heavier body does. A tool that is mounted
beside that line has an unbalance, too: mass times the distance from where the model has it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from diffsim.core.arrays import Array

BALANCED = 1e-3  # of the body's size: a center of mass as near to the joint shows no direction
FREE_AXES = 6  # of a free joint: such a body carries at its center of mass
MAX_CARRIERS = 8  # bodies of a model; where more may carry something, nobody can say which does


class Carrier(NamedTuple):
    """A body that may carry a payload."""

    mass: float  # its own [kg]
    length: float  # from its joint to its far end [m]


def carriers_of(mujoco: Any, model: Any) -> dict[str, Carrier]:
    """Bodies that may carry a payload.

    Those that end a chain: they carry no other moving body, or several. A body that is one of
    several on another, such as a wheel or a finger, is none: what it holds, that other one carries.

    Args:
        model: MuJoCo's model.
    """
    moving = [i for i in range(1, model.nbody) if (int(model.body_weldid[i]) == i)]
    parents = {i: int(model.body_parentid[i]) for i in moving}
    # what is fixed to the world, such as a hand on a table, carries each by itself
    under = {i: int(model.body_weldid[p]) or p for i, p in parents.items()}
    number = {i: sum(p == i for p in under.values()) for i in {*moving, *under.values()}}
    out, data = {}, mujoco.MjData(model)
    for i in moving:
        is_one_of_several = under[i] != 0 and number[under[i]] > 1
        if number[i] != 1 and not (number[i] == 0 and is_one_of_several):
            name, mass = model.body(i).name, float(model.body_mass[i])
            if name and mass > 0.0 and not _is_simple(model, i):
                joint, end = reach_of(mujoco, model, data, i)
                length = float(np.linalg.norm(end - joint)) or float(model.stat.meansize)
                out[name] = Carrier(mass, length)
    return out if len(out) <= MAX_CARRIERS else {}


def _is_simple(model: Any, i: int) -> bool:
    """Whether MuJoCo takes a body's mass matrix to be diagonal: its center stays on its joint."""
    is_free = int(model.body_dofnum[i]) == FREE_AXES
    return bool(model.body_simple[i]) and not is_free


def reach_of(mujoco: Any, model: Any, data: Any, body: int) -> tuple[Array, Array]:
    """A body's joint and its far end, with all that is fixed to it, in its frame, (3,) each [m].

    The far end lies on the line from the joint through the center of mass, where the body's
    shapes end. A body that is balanced about its joint, or has none, ends at its center of mass.

    Args:
        model: MuJoCo's model.
        data: Its data, which are computed anew.
    """
    mujoco.mj_resetData(model, data)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    place, axes = np.array(data.xpos[body]), np.array(data.xmat[body]).reshape(3, 3)
    own = np.flatnonzero(model.body_weldid == model.body_weldid[body])
    masses = model.body_mass[own]
    center = (masses @ data.xipos[own] / masses.sum() - place) @ axes
    joint = int(model.body_jntadr[body])
    if joint < 0 or int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE):
        return center, center
    start = np.array(model.jnt_pos[joint])
    shapes = np.flatnonzero(np.isin(model.geom_bodyid, own))
    away = (data.geom_xpos[shapes] - place) @ axes - start
    size = float((np.linalg.norm(away, axis=1) + model.geom_rbound[shapes]).max(initial=0.0))
    distance = float(np.linalg.norm(center - start))
    if distance <= BALANCED * size or distance == 0.0:
        return start, center
    way = (center - start) / distance
    # without shapes a uniform rod is as long as twice the way to its center of mass
    ends = [
        a @ way + _reach_of_shape(mujoco, model, data, g, axes @ way)
        for g, a in zip(shapes.tolist(), away, strict=True)
    ]
    end = float(max(ends, default=2.0 * distance))
    return start, start + max(end, distance) * way


def _reach_of_shape(mujoco: Any, model: Any, data: Any, geom: int, way: Array) -> float:
    """How far a shape reaches from its middle [m]; of a capsule its axis, where frames are put.

    Args:
        model: MuJoCo's model.
        data: Its data with places.
        way: Direction in the world, (3,).
    """
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    along = np.abs(way @ np.array(data.geom_xmat[geom]).reshape(3, 3))
    kind = int(model.geom_type[geom])
    if kind in (int(kinds.mjGEOM_CAPSULE), int(kinds.mjGEOM_CYLINDER)):
        return float(along[2] * size[1])
    if kind == int(kinds.mjGEOM_BOX):
        return float((along * size).max())
    return float(model.geom_rbound[geom])


def put_payload(mujoco: Any, model: Any, body: int, mass: float, place: Array) -> None:
    """Add a point mass to a body: its mass, center of mass and principal inertia.

    Args:
        model: Model that is changed.
        mass: Of the payload [kg].
        place: In the body's frame, (3,) [m].

    Raises:
        ValueError: MuJoCo takes the body to be simple.
    """
    before, old = float(model.body_mass[body]), np.array(model.body_ipos[body])
    total = before + mass
    model.body_mass[body] = total
    if mass == 0.0 or np.allclose(place, old, rtol=0.0, atol=1e-12):
        return
    if _is_simple(model, body):
        raise _held_center(model, body, "payload")
    center = (before * old + mass * place) / total
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    turn = axes.reshape(3, 3)
    inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
    for part, at in ((before, old), (mass, place)):
        d = at - center
        inertia += part * ((d @ d) * np.eye(3) - np.outer(d, d))
    moments, turn = np.linalg.eigh(inertia)
    turn[:, 2] *= np.sign(np.linalg.det(turn))  # a rotation, no mirror
    mujoco.mju_mat2Quat(model.body_iquat[body], np.ascontiguousarray(turn).ravel())
    model.body_inertia[body] = moments
    _put_center(model, body, center)


def put_unbalance(model: Any, body: int, moment: Array) -> None:
    """Move a body's center of mass; its mass and its inertia about that center stay.

    Args:
        model: Model that is changed, with its masses.
        moment: Mass times the way that the center moves, in the body's frame, (3,) [kg m].

    Raises:
        ValueError: MuJoCo takes the body to be simple.
    """
    if not moment.any():
        return
    if _is_simple(model, body):
        raise _held_center(model, body, "unbalance")
    _put_center(model, body, np.array(model.body_ipos[body]) + moment / model.body_mass[body])


def _put_center(model: Any, body: int, center: Array) -> None:
    model.body_ipos[body] = center
    # frames that were those of the inertia are their own now
    model.body_sameframe[body] = 0
    model.geom_sameframe[model.geom_bodyid == body] = 0
    model.site_sameframe[model.site_bodyid == body] = 0


def _held_center(model: Any, body: int, what: str) -> ValueError:
    return ValueError(
        f"parameter body.{model.body(body).name}.{what}: MuJoCo holds the body's center of "
        "mass where it is; say simple='false' of the body in the MJCF"
    )
