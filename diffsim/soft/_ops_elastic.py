"""The elastic, damping and pressure force of a soft body, its energy and derivatives as ops."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Op, array
from diffsim.soft._arrays import NODAL, EnergyArrays, require_array
from diffsim.soft._context import (
    context,
    context_of,
    owner,
    require_upright,
    sizes_of_call,
    soft_addresses,
)


class BoundGradient:
    """Gradients of one energy at many places, its parameters checked and handed over once.

    Args:
        arrays: Parameters of the energy, without damping; nobody may change them in place.
        batch: Number of items.
        handle: Of the body's prepared solvers.
        num_threads: Threads of the kernel.
    """

    def __init__(self, arrays: EnergyArrays, *, batch: int, handle: int, num_threads: int):
        self._context, self._num_threads = context(handle, arrays.tables), num_threads
        arrays.require_shapes(arrays.shapes(batch, self._context.sizes))
        self._inputs = soft_addresses(arrays.named())
        self._shape = (batch, self._context.num_nodes, 3)

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (batch, num_nodes, 3) [N] and energy (batch,) [J] at x, shape of the gradient
        [m]; the same bits as ``elastic_gradient``."""
        require_array("x", x, self._shape)
        gradient = torch.empty_like(x)
        energy = torch.empty(self._shape[0], dtype=torch.float64)
        core.elastic_gradient(
            pattern=self._context.pattern,
            inputs=self._inputs,
            batch=self._shape[0],
            x=x.data_ptr(),
            gradient=gradient.data_ptr(),
            energy=energy.data_ptr(),
            num_threads=self._num_threads,
        )
        require_upright(self._context, energy, x)
        return gradient, energy


def _gradient(call: Call) -> None:
    ctx = context_of(call)
    core.elastic_gradient(
        pattern=ctx.pattern,
        inputs=soft_addresses(EnergyArrays.of(call).named()),
        batch=call.sizes["batch"],
        **call.addresses("x", "gradient", "energy"),
        num_threads=call.sizes["num_threads"],
    )
    require_upright(ctx, call["energy"], call["x"])


def _items(call: Call, *names: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Every item of a batch, and what its kernels take."""
    arrays, ctx = EnergyArrays.of(call), context_of(call)
    for k in range(call.sizes["batch"]):
        yield (
            k,
            {
                "pattern": ctx.pattern,
                "inputs": soft_addresses(arrays.item(k)),
                **{name: call[name][k].data_ptr() for name in ("x", *names)},
                "num_threads": call.sizes["num_threads"],
            },
        )


def _item(tensors: dict[str, Tensor], k: int) -> object:
    return soft_addresses({n: t[k] if t.numel() else t for n, t in tensors.items()})


def _along(energies: Tensor, gradient: Tensor) -> Tensor:
    return energies[:, None, None] * gradient


def _is_damped(given: Any) -> bool:
    return bool(given["damp_mu"].numel())


def _gradient_adjoint(call: Call) -> None:
    """Hessian times what comes from behind, and so on for the parameters."""
    arrays = EnergyArrays.of(call)
    grads = arrays.gradients(call)
    call["z"] = call["grad_gradient"]
    for k, item in _items(call, "z", "grad_x"):
        core.elastic_gradient_adjoint(**item, grads=_item(grads, k))
    energies = call["grad_energy"]
    if not _is_damped(call) and bool(energies.any()):
        call["grad_x"] += _along(energies, call["gradient"])
        for name, slope in _slopes(call).items():
            if name in grads and slope.numel():
                grads[name] += slope * energies.reshape(-1, *(1,) * (slope.ndim - 1))
    arrays.add_gradients(call)


def _gradient_tangent(call: Call) -> None:
    arrays, dx = EnergyArrays.of(call), call["d_x"]
    moved = arrays.moved(call)
    call["tangent"] = call["d_gradient"]
    for k, item in _items(call, "tangent"):
        directions = soft_addresses(arrays.item_of(moved, k))
        at = dx[k].data_ptr() if dx.numel() else 0
        core.elastic_gradient_tangent(**item, dx=at, directions=directions)
    call["d_energy"] = (
        call["x"].new_zeros(len(call["x"])) if _is_damped(call) else _moved_energy(call)
    )


def _moved_energy(call: Call) -> Tensor:
    """The energy along the directions of positions and parameters, (batch,)."""
    rate = torch.zeros_like(call["x"][:, 0, 0])
    if call["d_x"].numel():
        rate = (call["gradient"] * call["d_x"]).sum((-2, -1))
    if moved := EnergyArrays.of(call).moved(call):
        slopes = _slopes(call)
        for name, direction in moved.items():
            rate = rate + (slopes[name] * direction).flatten(1).sum(1)
    return rate


INPUTS = {"x": array(*NODAL), **EnergyArrays.specs}
OPTIONS: dict[str, Any] = {
    "options": "int handle, int num_threads",
    "sizes": sizes_of_call,
    "owner": owner,
    "skips_still": True,
}
elastic_gradient = Op(  # of elastic, damping and pressure energy [N], and the energy [J]
    "elastic_gradient",
    inputs=INPUTS,
    outputs={"gradient": array(*NODAL), "energy": array("batch")},
    reads=("x", "gradient", *EnergyArrays.specs),
    kernel=_gradient,
    adjoint=_gradient_adjoint,
    tangent=_gradient_tangent,
    dropped=lambda given: ("energy",) if _is_damped(given) else (),  # not defined
    **OPTIONS,
)


def _slopes(call: Call) -> dict[str, Tensor]:
    """Slopes of each item's energy by its parameters; all have a batch axis."""
    arrays, batch = EnergyArrays.of(call), call.sizes["batch"]
    slopes = {
        n: t.new_zeros(t.shape if arrays.has_batch(n) else (batch, *t.shape))
        for n, t in arrays.named().items()
    }
    for k, item in _items(call):
        core.elastic_energy_slopes(**item, slopes=_item(slopes, k))
    return slopes


def _energy_adjoint(call: Call) -> None:
    energies = call["grad_energy"]
    for name, slope in _slopes(call).items():
        each = energies.reshape(-1, *(1,) * (slope.ndim - 1))
        call[f"grad_{name}"] = slope * each if slope.numel() else slope
    call["grad_x"] = _along(energies, call["gradient"])
    EnergyArrays.of(call).add_gradients(call)


def _energy_tangent(call: Call) -> None:
    call["d_energy"] = _moved_energy(call)


elastic_energy = Op(  # elastic and pressure energy [J], and its gradient [N]; without damping
    "elastic_energy",
    inputs=INPUTS,
    outputs={"energy": array("batch"), "gradient": array(*NODAL, smooth=False)},
    reads=("x", "gradient", *EnergyArrays.specs),
    kernel=_gradient,
    adjoint=_energy_adjoint,
    tangent=_energy_tangent,
    **OPTIONS,
)
