"""The elastic, damping and pressure force of a soft body and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, make_first_order, make_layer
from diffsim.soft._arrays import EnergyArrays, require_array
from diffsim.soft._context import SoftContext, context, require_upright, soft_addresses


def _require(ctx: SoftContext, inputs: list[Tensor], **nodal: Tensor) -> EnergyArrays:
    arrays = EnergyArrays.of(inputs)
    batch = next(iter(nodal.values())).shape[0]
    arrays.require_sizes(batch, ctx.sizes, damped=arrays.damped)
    for name, tensor in nodal.items():
        require_array(name, tensor, (batch, ctx.num_nodes, 3))
    return arrays


@custom_op("diffsim::elastic_gradient")
def elastic_gradient(
    x: Tensor, inputs: list[Tensor], *, handle: int, num_threads: int
) -> tuple[Tensor, Tensor]:
    """Gradient of elastic, damping and pressure energy [N], and the energy [J], per batch item.

    ``inputs`` are the tensors of an :class:`EnergyArrays`.
    """
    ctx = context(handle)
    arrays = _require(ctx, inputs, x=x)
    gradient = torch.empty_like(x)
    energy = torch.empty(x.shape[0], dtype=torch.float64)
    core.elastic_gradient(
        pattern=ctx.pattern,
        inputs=soft_addresses(arrays.named()),
        batch=x.shape[0],
        x=x.data_ptr(),
        gradient=gradient.data_ptr(),
        energy=energy.data_ptr(),
        num_threads=num_threads,
    )
    require_upright(ctx, energy, x)
    return gradient, energy


@elastic_gradient.register_fake
def _(x, inputs, **_options):
    return torch.empty_like(x), x.new_empty(x.shape[0])


class BoundGradient:
    """Gradients of one energy at many places, its parameters checked and handed over once.

    Args:
        arrays: Parameters of the energy, without damping; nobody may change them in place.
        batch: Number of items.
        handle, num_threads: As for :func:`elastic_gradient`.
    """

    def __init__(self, arrays: EnergyArrays, *, batch: int, handle: int, num_threads: int):
        self._context, self._num_threads = context(handle), num_threads
        arrays.require_sizes(batch, self._context.sizes, damped=False)
        self._arrays = arrays  # addresses are those of these tensors as long as they live
        self._inputs = soft_addresses(arrays.named())
        self._shape = (batch, self._context.num_nodes, 3)

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (batch, num_nodes, 3) [N] and energy (batch,) [J] at x, shape of the gradient
        [m]; the same bits as :func:`elastic_gradient`."""
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


@custom_op("diffsim::elastic_gradient_vjp")
def elastic_gradient_vjp(
    z: Tensor, x: Tensor, inputs: list[Tensor], *, handle: int, num_threads: int
) -> list[Tensor]:
    """Adjoint of the gradient output: Hessian times z, then the parameters in op order."""
    ctx = context(handle)
    z = z.contiguous()
    arrays = _require(ctx, inputs, x=x, z=z)
    grads = arrays.gradient_buffers(x.shape[0])
    grad_x = torch.empty_like(x)
    for k in range(x.shape[0]):
        core.elastic_gradient_adjoint(
            pattern=ctx.pattern,
            inputs=soft_addresses(arrays.item(k)),
            x=x[k].data_ptr(),
            z=z[k].data_ptr(),
            grad_x=grad_x[k].data_ptr(),
            grads=soft_addresses({n: g[k] if g.numel() else g for n, g in grads.items()}),
            num_threads=num_threads,
        )
    return [grad_x, *arrays.summed(grads)]


@elastic_gradient_vjp.register_fake
def _(z, x, inputs, **_options):
    return [torch.empty_like(x), *EnergyArrays.of(inputs).empty_gradients()]


def _elastic_setup(ctx, inputs, keyword_only_inputs, output):
    x, tensors = inputs
    ctx.arguments = keyword_only_inputs
    ctx.save_for_backward(x, output[0], *tensors)
    ctx.owner = context(keyword_only_inputs["handle"])
    ctx.damped = EnergyArrays.of(tensors).damped
    if ctx.damped:  # with damping frames the energy's own gradient is not defined
        ctx.mark_non_differentiable(output[1])


def _elastic_backward(ctx, grad_gradient, grad_energy):
    x, gradient, *tensors = ctx.saved_tensors
    g_x, *others = elastic_gradient_vjp_layer(grad_gradient, x, tensors, **ctx.arguments)
    if not ctx.damped:
        g_x = g_x + grad_energy[:, None, None] * gradient
    return g_x, EnergyArrays.all_gradients(others)


@custom_op("diffsim::elastic_gradient_jvp")
def elastic_gradient_jvp(
    x: Tensor,
    inputs: list[Tensor],
    dx: Tensor,
    directions: list[Tensor],
    *,
    handle: int,
    num_threads: int,
) -> Tensor:
    """The gradient output along one direction; ``dx`` and ``directions`` empty where still."""
    ctx = context(handle)
    x, dx = x.contiguous(), dx.contiguous()
    arrays = _require(ctx, inputs, x=x)
    moved = arrays.moving(directions)
    if dx.numel():
        require_array("dx", dx, tuple(x.shape))
    tangent = torch.empty_like(x)
    for k in range(x.shape[0]):
        core.elastic_gradient_tangent(
            pattern=ctx.pattern,
            inputs=soft_addresses(arrays.item(k)),
            x=x[k].data_ptr(),
            dx=dx[k].data_ptr() if dx.numel() else 0,
            directions=soft_addresses(arrays.item_of(moved, k)),
            tangent=tangent[k].data_ptr(),
            num_threads=num_threads,
        )
    return tangent


@elastic_gradient_jvp.register_fake
def _(x, inputs, dx, directions, **_options):
    return torch.empty_like(x)


def _elastic_tangent(ctx, dx, moved):
    x, gradient, *tensors = ctx.saved_tensors
    still = x.new_empty(0)
    tangent = elastic_gradient_jvp_layer(
        x,
        tensors,
        still if dx is None else dx,
        EnergyArrays.directions(moved, x),
        **ctx.arguments,
    )
    if ctx.damped:
        return tangent, None
    energy = torch.zeros_like(x[:, 0, 0]) if dx is None else (gradient * dx).sum((-2, -1))
    return tangent, energy  # as in reverse mode, of the positions alone


@custom_op("diffsim::elastic_energy")
def elastic_energy(
    x: Tensor, inputs: list[Tensor], *, handle: int, num_threads: int
) -> tuple[Tensor, Tensor]:
    """Elastic and pressure energy [J] per batch item, and its gradient in x [N].

    ``inputs`` are the tensors of an :class:`EnergyArrays` without damping.
    """
    gradient, energy = elastic_gradient(x, inputs, handle=handle, num_threads=num_threads)
    return energy, gradient


@elastic_energy.register_fake
def _(x, inputs, **_options):
    return x.new_empty(x.shape[0]), torch.empty_like(x)


@custom_op("diffsim::elastic_energy_slopes")
def elastic_energy_slopes(
    x: Tensor, inputs: list[Tensor], *, handle: int, num_threads: int
) -> list[Tensor]:
    """Slopes of each item's energy by its parameters, in op order; all have a batch axis."""
    ctx = context(handle)
    arrays = _require(ctx, inputs, x=x)
    slopes = arrays.gradient_buffers(x.shape[0])
    for k in range(x.shape[0]):
        core.elastic_energy_slopes(
            pattern=ctx.pattern,
            inputs=soft_addresses(arrays.item(k)),
            x=x[k].data_ptr(),
            slopes=soft_addresses({n: g[k] if g.numel() else g for n, g in slopes.items()}),
            num_threads=num_threads,
        )
    return list(slopes.values())


@elastic_energy_slopes.register_fake
def _(x, inputs, **_options):
    return list(EnergyArrays.of(inputs).gradient_buffers(x.shape[0]).values())


def _energy_setup(ctx, inputs, keyword_only_inputs, output):
    x, tensors = inputs
    ctx.arguments = keyword_only_inputs
    ctx.save_for_backward(x, output[1], *tensors)
    ctx.owner = context(keyword_only_inputs["handle"])
    ctx.mark_non_differentiable(output[1])


def _energy_backward(ctx, grad_energy, _grad_gradient):
    x, gradient, *tensors = ctx.saved_tensors
    arrays = EnergyArrays.of(tensors)
    slopes = elastic_energy_slopes_layer(x, tensors, **ctx.arguments)
    named = {
        name: slope * grad_energy.reshape(-1, *(1,) * (slope.ndim - 1)) if slope.numel() else slope
        for name, slope in zip(arrays.differentiable(), slopes, strict=True)
    }
    g_x = grad_energy[:, None, None] * gradient
    return g_x, EnergyArrays.all_gradients(arrays.summed(named))


def _energy_tangent(ctx, dx, moved):
    x, gradient, *tensors = ctx.saved_tensors
    arrays = EnergyArrays.of(tensors)
    slopes = elastic_energy_slopes_layer(x, tensors, **ctx.arguments)
    tangent = torch.zeros_like(x[:, 0, 0]) if dx is None else (gradient * dx).sum((-2, -1))
    directions = dict(zip(arrays.specs, moved, strict=True))
    for name, slope in zip(arrays.differentiable(), slopes, strict=True):
        if directions[name] is not None and slope.numel():
            tangent = tangent + (slope * directions[name]).flatten(1).sum(1)
    return tangent, None


elastic_energy_slopes_layer = make_first_order(elastic_energy_slopes)
elastic_energy_layer = make_layer(
    elastic_energy, setup=_energy_setup, backward=_energy_backward, tangent=_energy_tangent
)
elastic_gradient_vjp_layer = make_first_order(elastic_gradient_vjp)
elastic_gradient_jvp_layer = make_first_order(elastic_gradient_jvp)
elastic_gradient_layer = make_layer(
    elastic_gradient, setup=_elastic_setup, backward=_elastic_backward, tangent=_elastic_tangent
)
