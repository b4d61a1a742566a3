"""The elastic, damping and pressure force of a soft body and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.soft._context import (
    ENERGY_INPUTS,
    context,
    gradient_buffers,
    pointers,
    require_sizes,
    require_upright,
    sum_shared,
)


@torch.library.custom_op("diffsim::elastic_gradient", mutates_args=())
def elastic_gradient(
    x: Tensor, inputs: list[Tensor], handle: int, num_threads: int
) -> tuple[Tensor, Tensor]:
    """Gradient of elastic, damping and pressure energy [N], and the energy [J], per batch item.

    ``inputs`` are those of ``ENERGY_INPUTS``, in that order.
    """
    ctx = context(handle)
    named = dict(zip(ENERGY_INPUTS, inputs, strict=True))
    require_sizes(ctx, x.shape[0], {**named, "x": x})
    gradient = torch.empty_like(x)
    energy = torch.empty(x.shape[0], dtype=torch.float64)
    core.elastic_gradient(
        ctx.pattern,
        pointers(**named),
        x.shape[0],
        x.data_ptr(),
        gradient.data_ptr(),
        energy.data_ptr(),
        num_threads,
    )
    require_upright(ctx, energy, x)
    return gradient, energy


def _item(k: int, named: dict[str, Tensor]) -> object:
    batched = ("activation", "x_frame", "x_velocity", "pressure")
    return pointers(**{n: t[k] if n in batched and t.numel() else t for n, t in named.items()})


@elastic_gradient.register_fake
def _(x, *args):
    return torch.empty_like(x), x.new_empty(x.shape[0])


@torch.library.custom_op("diffsim::elastic_gradient_vjp", mutates_args=())
def elastic_gradient_vjp(
    z: Tensor, x: Tensor, inputs: list[Tensor], handle: int, num_threads: int
) -> list[Tensor]:
    """Adjoint of the gradient output: Hessian times z, then parameters in op order."""
    ctx = context(handle)
    batch = x.shape[0]
    named = dict(zip(ENERGY_INPUTS, inputs, strict=True))
    z = z.contiguous()
    require_sizes(ctx, batch, {**named, "x": x, "z": z})
    grads = gradient_buffers(named, ENERGY_INPUTS, batch)
    grad_x = torch.empty_like(x)
    for k in range(batch):
        core.elastic_gradient_adjoint(
            ctx.pattern,
            _item(k, named),
            x[k].data_ptr(),
            z[k].data_ptr(),
            grad_x[k].data_ptr(),
            pointers(**{name: g[k] if g.numel() else g for name, g in grads.items()}),
            num_threads,
        )
    return [grad_x, *sum_shared(grads)]


@elastic_gradient_vjp.register_fake
def _(z, x, inputs, *args):
    return [torch.empty_like(t) for t in (x, *inputs)]


def _elastic_setup(ctx, inputs, output):
    x, tensors, ctx.handle, ctx.num_threads = inputs
    ctx.save_for_backward(x, output[0], *tensors)
    ctx.owner = context(ctx.handle)
    ctx.damped = tensors[ENERGY_INPUTS.index("damp_mu")].numel() > 0
    if ctx.damped:  # with damping frames the energy's own gradient is not defined
        ctx.mark_non_differentiable(output[1])


def _elastic_backward(ctx, grad_gradient, grad_energy):
    x, gradient, *tensors = ctx.saved_tensors
    g_x, *others = elastic_gradient_vjp(grad_gradient, x, tensors, ctx.handle, ctx.num_threads)
    if not ctx.damped:
        g_x = g_x + grad_energy[:, None, None] * gradient
    return g_x, others, None, None


elastic_gradient.register_autograd(_elastic_backward, setup_context=_elastic_setup)
