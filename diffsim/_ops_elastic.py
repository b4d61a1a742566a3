"""The elastic and damping force of a soft body and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim._core import core
from diffsim._soft_context import (
    context,
    gradient_buffers,
    pointers,
    require_sizes,
    sum_shared,
)


@torch.library.custom_op("diffsim::elastic_gradient", mutates_args=())
def elastic_gradient(
    x: Tensor,
    w_mu: Tensor,
    w_vol: Tensor,
    fibre_stiffness: Tensor,
    activation: Tensor,
    damp_mu: Tensor,
    damp_lambda: Tensor,
    x_frame: Tensor,
    x_velocity: Tensor,
    handle: int,
    num_threads: int,
) -> tuple[Tensor, Tensor]:
    """Gradient of the elastic (and damping) energy [N] and the energy [J], per batch item."""
    ctx = context(handle)
    inputs = {
        "w_mu": w_mu,
        "w_vol": w_vol,
        "fibre_stiffness": fibre_stiffness,
        "activation": activation,
        "damp_mu": damp_mu,
        "damp_lambda": damp_lambda,
        "x_frame": x_frame,
        "x_velocity": x_velocity,
    }
    require_sizes(ctx, x.shape[0], {**inputs, "x": x})
    gradient = torch.empty_like(x)
    energy = torch.empty(x.shape[0], dtype=torch.float64)
    for k in range(x.shape[0]):
        core.elastic_gradient(
            ctx.pattern,
            _item(k, **inputs),
            x[k].data_ptr(),
            gradient[k].data_ptr(),
            energy[k].data_ptr(),
            num_threads,
        )
    return gradient, energy


def _item(k, w_mu, w_vol, fibre_stiffness, activation, damp_mu, damp_lambda, x_frame, x_velocity):
    return pointers(
        w_mu=w_mu,
        w_vol=w_vol,
        fibre_stiffness=fibre_stiffness,
        activation=activation[k],
        damp_mu=damp_mu,
        damp_lambda=damp_lambda,
        x_frame=x_frame[k] if x_frame.numel() else x_frame,
        x_velocity=x_velocity[k] if x_velocity.numel() else x_velocity,
    )


@elastic_gradient.register_fake
def _(x, *args):
    return torch.empty_like(x), x.new_empty(x.shape[0])


@torch.library.custom_op("diffsim::elastic_gradient_vjp", mutates_args=())
def elastic_gradient_vjp(
    z: Tensor,
    x: Tensor,
    w_mu: Tensor,
    w_vol: Tensor,
    fibre_stiffness: Tensor,
    activation: Tensor,
    damp_mu: Tensor,
    damp_lambda: Tensor,
    x_frame: Tensor,
    x_velocity: Tensor,
    handle: int,
    num_threads: int,
) -> list[Tensor]:
    """Adjoint of the gradient output: Hessian times z, then parameters in op order."""
    ctx = context(handle)
    batch = x.shape[0]
    inputs = {
        "w_mu": w_mu,
        "w_vol": w_vol,
        "fibre_stiffness": fibre_stiffness,
        "activation": activation,
        "damp_mu": damp_mu,
        "damp_lambda": damp_lambda,
        "x_frame": x_frame,
        "x_velocity": x_velocity,
    }
    z = z.contiguous()
    require_sizes(ctx, batch, {**inputs, "x": x, "z": z})
    grads = gradient_buffers(inputs, batch)
    grad_x = torch.empty_like(x)
    for k in range(batch):
        core.elastic_gradient_adjoint(
            ctx.pattern,
            _item(k, **inputs),
            x[k].data_ptr(),
            z[k].data_ptr(),
            grad_x[k].data_ptr(),
            pointers(**{name: g[k] if g.numel() else g for name, g in grads.items()}),
            num_threads,
        )
    return [grad_x, *sum_shared(grads)]


@elastic_gradient_vjp.register_fake
def _(z, x, w_mu, w_vol, fs, act, dm, dl, xf, xv, *args):
    return [torch.empty_like(t) for t in (x, w_mu, w_vol, fs, act, dm, dl, xf, xv)]


def _elastic_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:9], output[0])
    ctx.handle, ctx.num_threads = inputs[9:]
    ctx.owner = context(ctx.handle)
    if inputs[5].numel():  # with damping frames the energy's own gradient is not defined
        ctx.mark_non_differentiable(output[1])


def _elastic_backward(ctx, grad_gradient, grad_energy):
    *inputs, gradient = ctx.saved_tensors
    g_x, *others = elastic_gradient_vjp(grad_gradient, *inputs, ctx.handle, ctx.num_threads)
    if not inputs[5].numel():
        g_x = g_x + grad_energy[:, None, None] * gradient
    return g_x, *others, None, None


elastic_gradient.register_autograd(_elastic_backward, setup_context=_elastic_setup)
