"""Small bodies in round units (meter, second, tens of Pa), so that every gradient is of order
one."""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.soft import _ops_contact, _ops_elastic, _ops_step
from diffsim.soft.materials import CONSTANTS
from tests.helpers import with_derivatives

SHARP = {"rtol": 1e-12, "adjoint_rtol": 1e-12}  # solver noise below what finite differences see


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers that depend on nothing but their arguments."""
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def element_of(kind: str) -> str:
    """The element of a body on ``irregular_mesh(kind)``."""
    return kind if kind in soft.ELEMENTS else "standard"


KINDS = ["hex", "tet", "assumed_strain", "quadratic"]
"""Kinds of mesh with the standard element, and the other elements."""


def irregular_mesh(kind: str, cells=(2, 1, 1), size=(2.0, 1.0, 1.0), amount: float = 0.08):
    """A box whose nodes are all displaced, so that no two elements are alike; of ``KINDS``."""
    box = (mesh.tet_box if kind in ("tet", "quadratic") else mesh.hex_box)(cells, size)
    x = box.x_rest + amount * noise(box.num_nodes, 3, seed=9).clamp(-1.5, 1.5)
    moved = type(box)(x, box.elements)
    return mesh.split_tets(moved) if kind == "quadratic" else moved


def deformed(m, amount: float = 0.25, seed: int = 1) -> Tensor:
    """Positions far from rest: stretched, sheared, turned and noisy, without inverted elements."""
    stretch = torch.tensor(
        [[1.2, 0.3, 0.0], [-0.2, 0.9, 0.4], [0.1, -0.3, 0.8]], dtype=torch.float64
    )
    return m.x_rest @ stretch.T + amount * 0.3 * noise(m.num_nodes, 3, seed=seed)


def two_muscles() -> list[soft.Muscle]:
    """One muscle of each kind, through different elements, in directions of no symmetry."""
    first, second = torch.tensor([0, 1]), torch.tensor([1])
    return [
        soft.Muscle(elements=first, direction=[1.0, 0.2, -0.1], stiffness=8.0, kind="length"),
        soft.Muscle(elements=second, direction=[0.3, 1.0, 0.5], stiffness=6.0, kind="contraction"),
    ]


def rail_mask(m) -> Tensor:
    """Node 0 fixed, node 1 on a rail along x, node 2 held in z alone."""
    mask = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    mask[0] = True
    mask[1, 1:] = True
    mask[2, 2] = True
    return mask


OPTIONS = {"damping": soft.Damping, "masses": soft.Masses, "contact": soft.ContactOptions}


def grouped(arguments: dict) -> dict:
    """Constructor arguments of a body, those named like fields of its options put into these."""
    arguments = dict(arguments)
    for name, kind in OPTIONS.items():
        own = {f.name: arguments.pop(f.name) for f in fields(kind) if f.name in arguments}
        if own:
            arguments[name] = kind(**own)
    law = arguments.get("material", "pd")
    if not isinstance(law, soft.Material):  # its name leaves its own constants out
        law = soft.Material(law, **dict.fromkeys(CONSTANTS.get(law, ()), 0.3))
    if "volume_weight" in arguments:
        law = replace(law, volume_weight=arguments.pop("volume_weight"))
    return {**arguments, "material": law}


def soft_body(m, **changes) -> soft.SoftBody:
    """A body of order-one constants; ``changes`` replace arguments, or fields of its options."""
    arguments = {
        "dt": 0.1,
        "youngs_modulus": 30.0,
        "poissons_ratio": 0.3,
        "density": 1.5,
        "gravity": (0.3, -0.2, -1.0),
        "solver": soft.SolverOptions(**SHARP),
    }
    return soft.SoftBody(m, **grouped({**arguments, **changes}))


def leaf(value) -> Tensor:
    """A float64 tensor that asks for its gradient."""
    return torch.as_tensor(value, dtype=torch.float64).clone().requires_grad_()


MODULES = {"elastic": _ops_elastic, "contact": _ops_contact, "soft": _ops_step}


def record_calls(op: str, function):
    """What ``function`` returns, and (arguments by name, result) of each call of the op."""
    calls, module = [], MODULES[op.partition("_")[0]]
    row = getattr(module, op)

    def record(*args, **named):
        out = row(*args, **named)
        calls.append((dict(zip(row.arguments, args, strict=False)) | named, out))
        return out

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, op, record)
        return function(), calls


def recorded_op(op: str, function):
    """Checks of an op and its derivatives (:func:`tests.helpers.with_derivatives`), with the
    arguments of its first call."""
    row = getattr(MODULES[op.partition("_")[0]], op)
    given = record_calls(op, function)[1][0][0]
    args = [given[name] for name in row.arguments]
    args = [a.detach().requires_grad_(a.requires_grad) if torch.is_tensor(a) else a for a in args]
    return with_derivatives(row, *args)
