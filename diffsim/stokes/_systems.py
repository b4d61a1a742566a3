"""Prepared systems of a Stokes flow, which ops find by an integer handle.

Prepared C++ objects cannot be op arguments: ops carry the handle of the :class:`StokesContext` that
owns them.
"""

from __future__ import annotations

import itertools
import math
import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import FactorizationError
from diffsim.core.torch_names import on_constants

_handles = itertools.count(1)
contexts: weakref.WeakValueDictionary[int, StokesContext] = weakref.WeakValueDictionary()


class StokesContext:
    """Prepared systems of one grid, boundary set and discretization.

    A system is keyed by the level set alone: neither viscosity nor boundary values nor loads enter
    the factor. The last ``num_kept`` are kept; symbolic analyses of the last patterns too.

    Args:
        cells: Number of cells per axis.
        spacing: Cell size per axis [m].
        fixed: Prescribed components, (num_nodes, dim) bool.
        open_faces: Faces of the box without condition, axis by axis, low side first.
        options: Fields of ``FlowOptions`` (csrc/kernels/stokes/flow_operator.h).
        num_kept: Factorized systems to keep.
        inspect: Function called with the report and phi of every new system; may warn or raise.
    """

    def __init__(
        self,
        cells: Sequence[int],
        spacing: Sequence[float],
        *,
        fixed: Tensor,
        open_faces: Sequence[bool],
        options: dict[str, float | bool],
        num_kept: int,
        inspect: Callable[[object, Tensor], None],
    ):
        self.handle = next(_handles)
        self.dim = len(cells)
        self.num_nodes = math.prod(n + 1 for n in cells)
        self.num_cells = math.prod(cells)
        self.shape = core.make_grid_shape(tuple(cells), tuple(spacing))
        with on_constants():
            self.fixed = fixed.to(torch.uint8).contiguous()
        self.open_faces = tuple(open_faces)
        self.options = core.FlowOptions()
        for name, value in options.items():
            setattr(self.options, name, value)
        self.num_kept = num_kept
        self.inspect = inspect
        self.plan = core.StokesPlan()
        self.lock = threading.Lock()  # a system solves one thing at a time
        self._systems: list[tuple[Tensor, object]] = []  # latest last
        contexts[self.handle] = self

    @on_constants()
    def system(self, phi: Tensor, num_threads: int) -> Any:
        """The factorized system of a level set, from the cache where phi is equal."""
        known = self._find_system(phi)
        if known is not None:
            return known
        # Before the new one is made, and with no name left for it: two factors never share memory.
        del self._systems[: max(0, len(self._systems) + 1 - self.num_kept)]
        phi = phi.clone()
        system, unknown, pivot = core.make_stokes_system(
            shape=self.shape,
            phi=phi.data_ptr(),
            fixed=self.fixed.data_ptr(),
            open=self.open_faces,
            options=self.options,
            plan=self.plan,
            num_threads=num_threads,
        )
        if system is None:
            node, axis = divmod(unknown, self.dim)
            where = f"at node {node}, axis {axis}" if unknown >= 0 else "on a coarse grid"
            raise FactorizationError(
                f"the Stokes matrix is singular or indefinite {where} (pivot {pivot:.3e}); a part "
                "of the fluid has no wall, inlet or no-slip face that holds it: remove it, "
                "prescribe a velocity, or raise penalty and ghost_penalty",
                pivot=unknown,
                value=pivot,
            )
        self.inspect(system.report, phi)
        self._systems.append((phi, system))
        return system

    def _find_system(self, phi: Tensor) -> Any:
        """The kept system of an equal level set, now the latest, or None."""
        for i, (kept, system) in enumerate(self._systems):
            if torch.equal(kept, phi):
                self._systems.append(self._systems.pop(i))
                return system
        return None


def context(handle: int) -> StokesContext:
    """The context behind a handle."""
    owner = contexts.get(handle)
    if owner is None:
        raise RuntimeError(f"Stokes handle {handle} is gone: its StokesFlow was deleted")
    return owner
