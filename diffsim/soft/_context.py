"""Prepared solvers of soft bodies, and what the soft ops share.

Prepared C++ objects cannot be op arguments: ops carry an integer handle of the
:class:`SoftContext` that owns them.
"""

from __future__ import annotations

import itertools
import threading
import weakref
from collections import OrderedDict
from typing import Protocol

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import FactorizationError, InvertedElementError

_CACHED_SYSTEMS = 4
# Parameters of the elastic energy, as both soft ops take them.
ENERGY_INPUTS = (
    "w_mu",
    "w_vol",
    "fibre_stiffness",
    "activation",
    "damp_mu",
    "damp_lambda",
    "x_frame",
    "x_velocity",
    "pressure",
)
STEP_INPUTS = ("y", "force", "target", "guess", "inertia", *ENERGY_INPUTS)
STEP_GRADIENTS = tuple(name for name in STEP_INPUTS if name != "guess")
# Inputs without a batch axis.
SHARED_INPUTS = ("inertia", "w_mu", "w_vol", "fibre_stiffness", "damp_mu", "damp_lambda")
MATERIALS = ("pd", "corotated", "stable_neo_hookean", "neo_hookean", "stvk")
_handles = itertools.count(1)
contexts: weakref.WeakValueDictionary[int, SoftContext] = weakref.WeakValueDictionary()


class ChamberArrays(Protocol):
    """Chambers as kernels read them; :class:`diffsim.soft.chambers.ChamberSet` is one."""

    num_chambers: int
    num_lids: int
    start: Tensor
    faces: Tensor
    lid_chamber: Tensor
    lid_start: Tensor
    lid_nodes: Tensor


class SoftContext:
    """Prepared C++ objects of one mesh with its material law, fibres, chambers and Dirichlet set.

    The pattern (elements, sparsity, ordering) is made once. Constant systems are keyed by all that
    their content depends on; the last few are kept.
    """

    def __init__(
        self,
        *,
        is_hex: bool,
        material: str,
        elements: Tensor,
        grad: Tensor,
        weight: Tensor,
        class_idx: Tensor,
        x_rest: Tensor,
        fibre_elements: Tensor,
        fibre_directions: Tensor,
        fibre_pull_only: Tensor,
        chambers: ChamberArrays,
        fixed: Tensor,
    ):
        self.handle = next(_handles)
        self.material = material
        self.num_vertices = x_rest.shape[0]
        self.num_elements = elements.shape[0]
        self.num_fibres = fibre_elements.shape[0]
        self.num_chambers = chambers.num_chambers
        self.fixed = fixed.to(torch.uint8).contiguous()
        self.pattern = core.make_soft_pattern(
            is_hex=is_hex,
            material=getattr(core.Material, material),
            num_nodes=self.num_vertices,
            num_elements=self.num_elements,
            num_classes=grad.shape[0],
            num_fibres=self.num_fibres,
            num_chambers=self.num_chambers,
            num_lids=chambers.num_lids,
            elements=elements.data_ptr(),
            grad=grad.data_ptr(),
            weight=weight.data_ptr(),
            class_idx=class_idx.data_ptr(),
            coords=x_rest.data_ptr(),
            fibre_elements=fibre_elements.data_ptr(),
            fibre_directions=fibre_directions.data_ptr(),
            fibre_pull_only=fibre_pull_only.data_ptr(),
            chamber_start=chambers.start.data_ptr(),
            chamber_faces=chambers.faces.data_ptr(),
            lid_chamber=chambers.lid_chamber.data_ptr(),
            lid_start=chambers.lid_start.data_ptr(),
            lid_nodes=chambers.lid_nodes.data_ptr(),
        )
        self._systems: OrderedDict[tuple[Tensor, ...], object] = OrderedDict()
        self._lock = threading.Lock()
        contexts[self.handle] = self

    def system(self, inputs: dict[str, Tensor], num_threads: int) -> object:
        """The constant system of these inputs, from the cache where all it depends on is equal."""
        key = (inputs["inertia"], *(inputs[name] for name in _SYSTEM_PARAMETERS))
        with self._lock:
            for known in self._systems:
                if all(torch.equal(a, b) for a, b in zip(known, key, strict=True)):
                    self._systems.move_to_end(known)
                    return self._systems[known]
        key = tuple(k.contiguous().clone() for k in key)
        inertia, *values = key
        named = dict(zip(_SYSTEM_PARAMETERS, values, strict=True))
        kappa, fibre_kappa = preconditioner_stiffness(self.material, **named)
        made, node, pivot = core.make_constant_system(
            self.pattern,
            fixed=self.fixed.data_ptr(),
            inertia=inertia.data_ptr(),
            kappa=kappa.data_ptr(),
            fibre_kappa=fibre_kappa.data_ptr(),
            parameters=pointers(**named),
            num_threads=num_threads,
        )
        if made is None:
            raise FactorizationError(
                f"the soft body's constant matrix is singular at node {node} (pivot {pivot:.3e}); "
                "a static problem needs Dirichlet nodes on every axis, a dynamic one needs "
                "density > 0",
                pivot=node,
                value=pivot,
            )
        with self._lock:
            self._systems[key] = made
            while len(self._systems) > _CACHED_SYSTEMS:
                self._systems.popitem(last=False)
        return made


def context(handle: int) -> SoftContext:
    """The context behind a handle."""
    found = contexts.get(handle)
    if found is None:
        raise RuntimeError(f"soft-body handle {handle} is gone: its SoftBody was deleted")
    return found


# What a constant system depends on, apart from the inertias.
_SYSTEM_PARAMETERS = ("w_mu", "w_vol", "fibre_stiffness", "damp_mu", "damp_lambda")
# Shares of the volume and fibre stiffness in the constant matrix, measured in benchmarks/soft.py.
VOLUME_SHARE = 0.1
FIBRE_SHARE = 0.5


def preconditioner_stiffness(
    material: str,
    w_mu: Tensor,
    w_vol: Tensor,
    fibre_stiffness: Tensor,
    damp_mu: Tensor,
    damp_lambda: Tensor,
) -> tuple[Tensor, Tensor]:
    """Stiffness kappa of A = diag(inertia) + sum kappa G^T G, of elements and of fibres [Pa].

    The volume term acts on one of nine directions of F; with its full weight (eq. 4.15) A is far
    too stiff in the other eight. All materials are alike at small strain, where PD's w_vol stands
    for 3 lambda.
    """
    kappa = w_mu + VOLUME_SHARE * 3.0 * small_strain_lambda(material, w_vol)
    if damp_mu.numel():
        kappa = kappa + 0.75 * damp_mu + 0.3 * damp_lambda
    return kappa, FIBRE_SHARE * fibre_stiffness


def small_strain_lambda(material: str, w_vol: Tensor) -> Tensor:
    """First Lame parameter that a solid of volume parameter ``w_vol`` has at small strain [Pa]."""
    return w_vol / 3.0 if material == "pd" else w_vol


def require_upright(ctx: SoftContext, energy: Tensor, x: Tensor) -> None:
    """Refuse positions (batch, V, 3) [m] at which the textbook neo-Hookean energy is infinite."""
    if ctx.material != "neo_hookean" or bool(torch.isfinite(energy).all()):
        return
    item = int(torch.nonzero(~torch.isfinite(energy))[0, 0])
    count = core.count_inverted(ctx.pattern, x[item].contiguous().data_ptr())
    if count:
        raise InvertedElementError(
            f"{count} of {ctx.num_elements} elements are inverted, where the neo_hookean energy is "
            "infinite; start from a state without inverted elements, move Dirichlet nodes and step "
            "in time by less, or use material='stable_neo_hookean'",
            num_inverted=count,
        )


def require_sizes(ctx: SoftContext, batch: int, tensors: dict[str, Tensor]) -> None:
    """Kernels read whole arrays: refuse any other size before they do."""
    expected = {
        "activation": (batch, ctx.num_fibres),
        "pressure": (batch, ctx.num_chambers),
        "fibre_stiffness": (ctx.num_fibres,),
        "inertia": (ctx.num_vertices,),
        **dict.fromkeys(("w_mu", "w_vol", "damp_mu", "damp_lambda"), (ctx.num_elements,)),
    }
    damped = tensors["damp_mu"].numel() > 0
    for name, tensor in tensors.items():
        shape = expected.get(name, (batch, ctx.num_vertices, 3))
        if not damped and name in ("damp_mu", "damp_lambda", "x_frame", "x_velocity"):
            shape = (0,)
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if tensor.dtype != torch.float64 or not tensor.is_contiguous():
            raise TypeError(f"{name} must be contiguous float64")


def pointers(**tensors: Tensor) -> object:
    arrays = core.SoftArrays()
    for name, tensor in tensors.items():
        if tensor.numel():
            setattr(arrays, name, tensor.data_ptr())
    return arrays


def gradient_buffers(
    inputs: dict[str, Tensor], names: tuple[str, ...], batch: int
) -> dict[str, Tensor]:
    """Zeroed outputs; those of shared parameters get a batch axis, summed afterwards in order."""
    return {
        name: inputs[name].new_zeros(
            (batch, *inputs[name].shape) if name in SHARED_INPUTS else inputs[name].shape
        )
        for name in names
    }


def sum_shared(grads: dict[str, Tensor]) -> list[Tensor]:
    return [
        (g[0].clone() if g.shape[0] == 1 else g.sum(0)) if name in SHARED_INPUTS else g
        for name, g in grads.items()
    ]
