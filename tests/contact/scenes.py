"""Bodies in contact, and the contact law checked from the outside.

:func:`violations` shares nothing with the contact kernels: the residual is written from the
integrator's own formula and the body's elastic force, the slip from velocities.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.soft._ops_contact import SLIDING_FRICTION
from tests.soft.cases import noise, soft_body

ZERO = (0.0, 0.0, 0.0)


def slab(kind: str = "hex", cells=(2, 2, 1), size=(1.0, 1.0, 0.5), height: float = 0.0, **changes):
    """A box whose lowest nodes are at z = height, of order-one constants, gravity along -z."""
    make = mesh.hex_box if kind == "hex" else mesh.tet_box
    m = make(cells, size, origin=(-0.5 * size[0], -0.5 * size[1], height))
    return soft_body(m, **{"gravity": (0.0, 0.0, -1.0), "youngs_modulus": 100.0, **changes})


def moving(body, velocity=ZERO, spin=ZERO, wobble: float = 0.0, seed: int = 2) -> soft.State:
    """The rest shape with a rigid motion about its center and random velocities on top."""
    x = body.x_rest.clone()
    arm = x - mass_mean(body, x)
    turn = torch.linalg.cross(torch.tensor(spin, dtype=x.dtype).expand_as(arm), arm)
    v = torch.tensor(velocity, dtype=x.dtype) + turn + wobble * noise(*x.shape, seed=seed)
    return soft.State(x, v)


def mass_mean(body, field: Tensor) -> Tensor:
    """Mean over nodes weighted by mass: (..., num_nodes, 3) -> (..., 3)."""
    mass = body.physics().mass
    return (mass[:, None] * field).sum(-2) / mass.sum()


def residual(body, before, after, external=None, activation=None, physics=None) -> Tensor:
    """M a - f(x1) - external force: what contact must have supplied [N]; undamped bodies."""
    physics = body.physics() if physics is None else physics
    mass, h = physics.mass[:, None], body.dt
    if body.integrator == "bdf2" and before.v_prev is not None:
        acceleration = (1.5 * after.v - 2.0 * before.v + 0.5 * before.v_prev) / h
    else:
        acceleration = (after.v - before.v) / h
    r = mass * (acceleration + physics.rayleigh_alpha * after.v)
    r = r - physics.weighing_mass[:, None] * physics.gravity
    r = r - body.elastic_force(after.x, activation=activation, physics=physics)
    return r if external is None else r - external


class Violations(NamedTuple):
    """How far a step is from the contact law; forces by the largest force, lengths by the body."""

    equation: float  # residual minus contact force, at all nodes that are not fixed
    gap: float  # depth below the step's half spaces
    pull: float  # negative normal force
    both: float  # min(gap, r_N) over nodes: complementarity
    cone: float  # |r_T| - mu r_N
    # friction of slipping nodes, |r_T + mu r_N t|; counts less below 1e-6 lengths of slip
    slip: float
    num_contacts: int  # nodes with a contact force
    num_slipping: int  # of these, nodes on the edge of the cone

    @property
    def worst(self) -> float:
        return max(self[:6])


def violations(body, before, after, obstacles, external=None, **inputs) -> Violations:
    """Check one step of a single body (no batch axes) against the contact law.

    Half spaces come from ``contact.detect`` at the inertial positions, slip from velocities
    relative to the obstacle's displacement over the step.
    """
    many = [obstacles] if isinstance(obstacles, contact.Obstacle) else obstacles
    nodes, h = body.contact_nodes, body.dt
    start = before.x[nodes]
    multistep = body.integrator == "bdf2" and before.v_prev is not None
    inertial = before.x + h * before.v
    if multistep:
        inertial = (4 * before.x - before.x_prev) / 3 + 2 * h / 9 * (4 * before.v - before.v_prev)
    planes = contact.detect(
        many, start, inertial[nodes], h, max_depenetration_speed=body.max_depenetration_speed
    )
    r = residual(body, before, after, external, **inputs)
    force = after.contact_force
    assert force is not None
    free = ~body.fixed
    scale_force = float(force.abs().max()) or float(body.physics().mass.max() / h**2)
    size = float((before.x.max(0).values - before.x.min(0).values).max())
    others = torch.ones(len(r), dtype=torch.bool)
    others[nodes] = False
    assert bool((force[others] == 0.0).all())
    n = planes.normal
    gap = (n * (after.x[nodes] - planes.reference)).sum(-1) - planes.offset
    f = force[nodes]
    normal = (n * f).sum(-1)
    tangent = f - normal[:, None] * n
    slip = after.v[nodes] - (planes.reference - start) / h
    slip = slip - (n * slip).sum(-1, keepdim=True) * n
    size_t, speed = tangent.norm(dim=-1), slip.norm(dim=-1)
    pressed = normal.clamp(min=0.0)
    # what infinite friction would have to pull slides with a finite one: docs/contact.md
    slides = planes.friction.isinf() & (normal > 0.0) & (speed * h > 1e-6 * size)
    friction = torch.where(slides, SLIDING_FRICTION, planes.friction)
    rough = friction.isinf()
    limit = torch.where(rough, math.inf, friction * pressed)
    # nan_to_num: inf * 0 where a node with infinite friction is not in contact
    limit = torch.nan_to_num(limit, nan=0.0, posinf=math.inf)
    direction = slip / speed.clamp(min=1e-300)[:, None]
    opposite = (tangent + torch.where(rough, 0.0, limit)[:, None] * direction).norm(dim=-1)
    touching = f.abs().amax(-1) > 0
    weight = torch.where(touching, speed * h / (1e-6 * size), 0.0).clamp(max=1.0)
    opposite = torch.where(rough, size_t, opposite)
    return Violations(
        equation=float(((r - force) * free).abs().max()) / scale_force,
        gap=float((-gap).clamp(min=0).max()) / size,
        pull=float((-normal).clamp(min=0).max()) / scale_force,
        both=float(torch.minimum(gap / size, normal / scale_force).max()),
        cone=float((size_t - limit).clamp(min=0).max()) / scale_force,
        slip=float((weight * opposite).max()) / scale_force,
        num_contacts=int(touching.sum()),
        num_slipping=int((touching & ~rough & (size_t >= (1 - 1e-9) * limit)).sum()),
    )
