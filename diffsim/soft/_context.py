"""Prepared solvers of soft bodies, and what the soft ops share.

Prepared C++ objects cannot be op arguments: ops carry an integer handle of the
:class:`SoftContext` that owns them.
"""

from __future__ import annotations

import itertools
import threading
import weakref
from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import FactorizationError, InvertedElementError
from diffsim.core.ops import Call
from diffsim.soft._arrays import StepArrays
from diffsim.soft.elements import ElementTables
from diffsim.soft.materials import NEEDS_POSITIVE_J, small_strain_moduli

_CACHED_SYSTEMS = 4
_CACHED_SHAPES = 8
PRECONDITIONERS = ("auto", "constant", "multigrid")
MULTIGRID_METHODS = ("auto", "newton_pcg", "linearly_implicit")
# Forces are squared and summed: beyond these powers of ten float64 has no room for that.
LENGTHS, STIFFNESSES = (1e-60, 1e60), (1e-75, 1e75)
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
    """Prepared C++ objects of one mesh with its material law, fibers, chambers and Dirichlet set.

    The pattern (elements, sparsity, ordering) is made once. Constant systems are keyed by all that
    their content depends on; the last few are kept.
    """

    def __init__(
        self,
        *,
        material: str,
        tables: ElementTables,
        x_rest: Tensor,
        fiber_elements: Tensor,
        fiber_directions: Tensor,
        fiber_pull_only: Tensor,
        chambers: ChamberArrays,
        fixed: Tensor,
    ):
        extent = (x_rest.amax(0) - x_rest.amin(0)).max().reshape(1)
        require_magnitude("the body's longest side [m]", extent, LENGTHS)
        self.handle = next(_handles)
        self.material = material
        self.num_nodes = x_rest.shape[0]
        self.num_elements = tables.elements.shape[0]
        self.num_fibers = fiber_elements.shape[0]
        self.num_chambers = chambers.num_chambers
        self.fixed = fixed.to(torch.uint8).contiguous()
        self.pattern = core.make_soft_pattern(
            kind=getattr(core.ElementKind, tables.kind),
            material=material,
            num_nodes=self.num_nodes,
            num_elements=self.num_elements,
            num_classes=tables.grad.shape[0],
            num_fibers=self.num_fibers,
            num_chambers=self.num_chambers,
            num_lids=chambers.num_lids,
            elements=tables.elements.data_ptr(),
            grad=tables.grad.data_ptr(),
            weight=tables.weight.data_ptr(),
            hourglass=tables.hourglass.data_ptr(),
            class_idx=tables.class_idx.data_ptr(),
            coords=x_rest.data_ptr(),
            fiber_elements=fiber_elements.data_ptr(),
            fiber_directions=fiber_directions.data_ptr(),
            fiber_pull_only=fiber_pull_only.data_ptr(),
            chamber_start=chambers.start.data_ptr(),
            chamber_faces=chambers.faces.data_ptr(),
            lid_chamber=chambers.lid_chamber.data_ptr(),
            lid_start=chambers.lid_start.data_ptr(),
            lid_nodes=chambers.lid_nodes.data_ptr(),
        )
        self._systems: OrderedDict[tuple[tuple[str, bool], tuple[Tensor, ...]], object]
        self._systems = OrderedDict()
        self._tables, self._shapes = tables, list[tuple[Tensor, SoftContext]]()
        self._remade = partial(
            SoftContext,
            material=material,
            x_rest=x_rest,
            fiber_elements=fiber_elements,
            fiber_pull_only=fiber_pull_only,
            chambers=chambers,
            fixed=fixed,
        )
        # sizes of arrays by name, see :mod:`diffsim.soft._arrays`; a graph cannot ask the pattern
        self.sizes = {
            "num_nodes": self.num_nodes,
            "num_elements": self.num_elements,
            "num_weights": self.pattern.num_weights,
            "num_fibers": self.num_fibers,
            "num_chambers": self.num_chambers,
            "num_tables": self.pattern.num_tables,
        }
        self._lock = threading.Lock()
        contexts[self.handle] = self

    def of_shape(self, tables: Tensor) -> SoftContext:
        """The prepared objects of another rest shape of the mesh; of this one for empty tables.

        Args:
            tables: Of the shape, (num_tables,), see :mod:`diffsim.soft.rest_shape`.
        """
        if not tables.numel():
            return self
        with self._lock:
            for place, (known, made) in enumerate(self._shapes):
                if torch.equal(known, tables):
                    self._shapes.insert(0, self._shapes.pop(place))
                    return made
        key = tables.detach().contiguous().clone()
        own = 3 * self.num_fibers
        rows, directions = key.split([len(key) - own, own])
        made = self._remade(
            tables=self._tables.replaced_by(rows.reshape(self.num_elements, -1)),
            fiber_directions=directions.contiguous(),
        )
        with self._lock:
            self._shapes.insert(0, (key, made))
            del self._shapes[_CACHED_SHAPES:]
        return made

    def system(
        self,
        inputs: StepArrays,
        num_threads: int,
        method: str,
        preconditioner: str,
        *,
        in_contact: bool = False,
    ) -> object:
        """The constant system of these inputs, from the cache where all it depends on is equal.

        Args:
            inputs: What it depends on is among them.
            num_threads: Threads to make it with.
            method, preconditioner: As in :class:`~diffsim.soft.SolverOptions`.
            in_contact: Whether steps in contact are to be planned.
        """
        by_choice = method in ("auto", "linearly_implicit") or preconditioner == "multigrid"
        kind = (preconditioner if by_choice else "constant", in_contact)
        shared = inputs.shared()  # all that it depends on, but the shape, of which this is
        del shared["tables"]
        key = tuple(shared.values())
        with self._lock:
            for known in self._systems:
                if known[0] == kind and all(map(torch.equal, known[1], key)):
                    self._systems.move_to_end(known)
                    return self._systems[known]
        key = tuple(k.contiguous().clone() for k in key)
        shared = dict(zip(shared, key, strict=True))
        inertia = shared.pop("inertia")
        kappa, fiber_kappa = preconditioner_stiffness(self.material, **shared)
        require_magnitude("mass / dt^2 [N/m]", inertia, STIFFNESSES)
        require_magnitude("stiffness of youngs_modulus, poissons_ratio [Pa]", kappa, STIFFNESSES)
        made, node, pivot = core.make_constant_system(
            self.pattern,
            fixed=self.fixed.data_ptr(),
            inertia=inertia.data_ptr(),
            kappa=kappa.data_ptr(),
            fiber_kappa=fiber_kappa.data_ptr(),
            parameters=soft_addresses(shared),
            preconditioner=getattr(core.Preconditioner, kind[0]),
            in_contact=in_contact,
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
            self._systems[(kind, key)] = made
            while len(self._systems) > _CACHED_SYSTEMS:
                self._systems.popitem(last=False)
        return made


def context(handle: int, tables: Tensor | None = None) -> SoftContext:
    """The context behind a handle, of the shape that some tables are of."""
    found = contexts.get(handle)
    if found is None:
        raise RuntimeError(f"soft-body handle {handle} is gone: its SoftBody was deleted")
    return found if tables is None else found.of_shape(tables)


def owner(options: Mapping[str, Any]) -> SoftContext:
    """The prepared solver that ops with these options need, of a deleted body, too."""
    return context(options["handle"])


def context_of(call: Call) -> SoftContext:
    """The prepared solver of a call, of the rest shape that it has."""
    return context(call.options["handle"], call["tables"])


def sizes_of_call(call: Call) -> dict[str, Any]:
    """Sizes of the arrays of an op."""
    batch = call["activation"].shape[0]
    each = (batch,) if call["weights"].ndim == 3 else ()
    return {**owner(call.options).sizes, "batch": batch, "...": each}


# Shares of the volume and fiber stiffness in the constant matrix, measured in benchmarks/soft.py.
VOLUME_SHARE = 0.1
FIBER_SHARE = 0.5


def preconditioner_stiffness(
    material: str,
    weights: Tensor,
    fiber_stiffness: Tensor,
    damp_mu: Tensor,
    damp_lambda: Tensor,
) -> tuple[Tensor, Tensor]:
    """Stiffness kappa of A = diag(inertia) + sum kappa G^T G, of elements and of fibers [Pa].

    The volume term acts on one of nine directions of F; with its full weight (eq. 4.15) A is far
    too stiff in the other eight. All materials are alike at small strain, so that its moduli are
    all that A depends on.
    """
    moduli = small_strain_moduli(material, weights)
    kappa = moduli.two_mu + VOLUME_SHARE * 3.0 * moduli.lame_lambda
    if damp_mu.numel():
        kappa = kappa + 0.75 * damp_mu + 0.3 * damp_lambda
    return kappa, FIBER_SHARE * fiber_stiffness


def require_magnitude(name: str, values: Tensor, bounds: tuple[float, float]) -> None:
    """Refuse positive values whose squares underflow or overflow; a step would be wrong unseen."""
    low, high = bounds
    odd = values[((values < low) & (values > 0.0)) | (values > high)]
    if odd.numel():
        raise ValueError(
            f"{name} must lie between {low:g} and {high:g}, where float64 has room for squares, "
            f"got {float(odd[0]):g}; choose other units of length, time and mass"
        )


def require_upright(ctx: SoftContext, energy: Tensor, x: Tensor) -> None:
    """Refuse positions (batch, V, 3) [m] at which the energy of an upright material is infinite."""
    if ctx.material not in NEEDS_POSITIVE_J or bool(torch.isfinite(energy).all()):
        return
    item = int(torch.nonzero(~torch.isfinite(energy))[0, 0])
    count = core.count_inverted(ctx.pattern, x[item].contiguous().data_ptr())
    if count:
        raise InvertedElementError(
            f"{count} of {ctx.num_elements} elements are inverted, where the energy of "
            f"{ctx.material} is infinite; start from a state without inverted elements, move "
            "Dirichlet nodes and step in time by less, or use material='stable_neo_hookean'",
            num_inverted=count,
        )


def soft_addresses(tensors: Mapping[str, Tensor]) -> object:
    """Addresses of a soft body's arrays by name; what is empty or missing stays absent."""
    arrays = core.SoftArrays()
    arrays.per_member = "weights" in tensors and tensors["weights"].ndim == 3
    return _fill(arrays, tensors)


def contact_addresses(num_contacts: int, tensors: Mapping[str, Tensor]) -> object:
    """Addresses of contacts' arrays by name, ``node`` among them."""
    arrays = core.ContactArrays()
    arrays.num_contacts = num_contacts
    return _fill(arrays, tensors)


def _fill(arrays: Any, tensors: Mapping[str, Tensor]) -> object:
    arrays.tensors = tensors  # addresses are those of these tensors as long as they live
    for name, tensor in tensors.items():
        if tensor.numel():
            setattr(arrays, name, tensor.data_ptr())
    return arrays
