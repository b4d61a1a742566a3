"""Soft-body ops: the implicit step, the elastic force, and their adjoints, as torch custom ops.

Everything here has a leading batch axis and float64. Prepared C++ objects cannot be op arguments:
ops carry an integer handle of the :class:`SoftContext` that owns them.
"""

from __future__ import annotations

import itertools
import math
import threading
import warnings
import weakref
from collections import OrderedDict
from collections.abc import Callable

import torch
from torch import Tensor

from diffsim._core import core
from diffsim.errors import ConvergenceError, ConvergenceWarning, FactorizationError

METHODS = ("auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky")
STATS = (
    "residual_norm",
    "tolerance",
    "scale",
    "num_iters",
    "num_solves",
    "num_factorizations",
    "energy",
    "converged",
)
_CACHED_SYSTEMS = 4
_handles = itertools.count(1)
_contexts: weakref.WeakValueDictionary[int, SoftContext] = weakref.WeakValueDictionary()


class SoftContext:
    """Prepared C++ objects of one mesh with its fibres and Dirichlet set.

    The pattern (elements, sparsity, ordering) is made once. Constant systems are keyed by all that
    their content depends on; the last few are kept.
    """

    def __init__(
        self,
        *,
        is_hex: bool,
        elements: Tensor,
        grad: Tensor,
        weight: Tensor,
        class_idx: Tensor,
        x_rest: Tensor,
        fibre_elements: Tensor,
        fibre_directions: Tensor,
        fixed: Tensor,
    ):
        self.handle = next(_handles)
        self.num_vertices = x_rest.shape[0]
        self.num_elements = elements.shape[0]
        self.num_fibres = fibre_elements.shape[0]
        self.fixed = fixed.to(torch.uint8).contiguous()
        self.pattern = core.make_soft_pattern(
            is_hex=is_hex,
            num_nodes=self.num_vertices,
            num_elements=self.num_elements,
            num_classes=grad.shape[0],
            num_fibres=self.num_fibres,
            elements=elements.data_ptr(),
            grad=grad.data_ptr(),
            weight=weight.data_ptr(),
            class_idx=class_idx.data_ptr(),
            coords=x_rest.data_ptr(),
            fibre_elements=fibre_elements.data_ptr(),
            fibre_directions=fibre_directions.data_ptr(),
        )
        self._systems: OrderedDict[tuple[Tensor, ...], object] = OrderedDict()
        self._lock = threading.Lock()
        _contexts[self.handle] = self

    def system(self, inertia: Tensor, parameters: dict[str, Tensor], num_threads: int) -> object:
        """The constant system of these inertias and parameters, from the cache if all are equal."""
        key = (inertia, *(parameters[name] for name in _SYSTEM_PARAMETERS))
        with self._lock:
            for known in self._systems:
                if all(torch.equal(a, b) for a, b in zip(known, key, strict=True)):
                    self._systems.move_to_end(known)
                    return self._systems[known]
        key = tuple(k.contiguous().clone() for k in key)
        inertia, *values = key
        named = dict(zip(_SYSTEM_PARAMETERS, values, strict=True))
        kappa, fibre_kappa = preconditioner_stiffness(**named)
        made, node, pivot = core.make_constant_system(
            self.pattern,
            fixed=self.fixed.data_ptr(),
            inertia=inertia.data_ptr(),
            kappa=kappa.data_ptr(),
            fibre_kappa=fibre_kappa.data_ptr(),
            parameters=_pointers(**named),
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
    found = _contexts.get(handle)
    if found is None:
        raise RuntimeError(f"soft-body handle {handle} is gone: its SoftBody was deleted")
    return found


# What a constant system depends on, apart from the inertias.
_SYSTEM_PARAMETERS = ("w_mu", "w_vol", "fibre_stiffness", "damp_mu", "damp_lambda")
# Shares of the volume and fibre stiffness in the constant matrix, measured in benchmarks/soft.py.
VOLUME_SHARE = 0.1
FIBRE_SHARE = 0.5


def preconditioner_stiffness(
    w_mu: Tensor, w_vol: Tensor, fibre_stiffness: Tensor, damp_mu: Tensor, damp_lambda: Tensor
) -> tuple[Tensor, Tensor]:
    """Stiffness kappa of A = diag(inertia) + sum kappa G^T G, of elements and of fibres [Pa].

    The volume term acts on one of nine directions of F; with its full weight (eq. 4.15) A is far
    too stiff in the other eight.
    """
    kappa = w_mu + VOLUME_SHARE * w_vol
    if damp_mu.numel():
        kappa = kappa + 0.75 * damp_mu + 0.3 * damp_lambda
    return kappa, FIBRE_SHARE * fibre_stiffness


def _require_sizes(ctx: SoftContext, batch: int, tensors: dict[str, Tensor]) -> None:
    """Kernels read whole arrays: refuse any other size before they do."""
    expected = {
        "activation": (batch, ctx.num_fibres),
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


def _pointers(**tensors: Tensor) -> object:
    arrays = core.SoftArrays()
    for name, tensor in tensors.items():
        if tensor.numel():
            setattr(arrays, name, tensor.data_ptr())
    return arrays


def _options(method: str, rtol: float, atol: float, max_iters: int) -> object:
    options = core.StepOptions()
    options.method = getattr(core.StepMethod, method)
    options.rtol, options.atol, options.max_iters = rtol, atol, max_iters
    return options


listeners: list[Callable[[str, Tensor], None]] = []
"""Called with ("step" or "adjoint", stats) after every solve; see diffsim.soft.record_stats."""


def _notify(kind: str, stats: Tensor) -> None:
    for listen in listeners:
        listen(kind, stats)


def _report(stats: Tensor, what: str, hint: str, on_failure: str) -> None:
    failed = stats[:, 7] == 0
    if not bool(failed.any()):
        return
    row = stats[failed][0]
    residual, tolerance, iters = float(row[0]), float(row[1]), int(row[3])
    message = (
        f"{what} stopped after {iters} iterations at residual {residual:.3e}, needed "
        f"{tolerance:.3e}; {hint}"
    )
    if on_failure == "warn" and math.isfinite(residual):
        warnings.warn(message, ConvergenceWarning, stacklevel=2)
        return
    raise ConvergenceError(message, residual_norm=residual, tolerance=tolerance, num_iters=iters)


@torch.library.custom_op("diffsim::soft_step", mutates_args=())
def soft_step(
    y: Tensor,
    force: Tensor,
    target: Tensor,
    guess: Tensor,
    inertia: Tensor,
    w_mu: Tensor,
    w_vol: Tensor,
    fibre_stiffness: Tensor,
    activation: Tensor,
    damp_mu: Tensor,
    damp_lambda: Tensor,
    x_frame: Tensor,
    x_velocity: Tensor,
    handle: int,
    method: str,
    rtol: float,
    atol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
    adjoint_rtol: float,
    adjoint_max_iters: int,
) -> tuple[Tensor, Tensor]:
    """One implicit step of a batch; see csrc/kernels/soft/implicit_step.h. Returns x and stats."""
    ctx = context(handle)
    inputs = {
        "y": y,
        "force": force,
        "target": target,
        "guess": guess,
        "w_mu": w_mu,
        "w_vol": w_vol,
        "fibre_stiffness": fibre_stiffness,
        "activation": activation,
        "damp_mu": damp_mu,
        "damp_lambda": damp_lambda,
        "x_frame": x_frame,
        "x_velocity": x_velocity,
    }
    _require_sizes(ctx, y.shape[0], {**inputs, "inertia": inertia})
    system = ctx.system(inertia, inputs, num_threads)
    x = torch.empty_like(y)
    stats = torch.zeros(y.shape[0], len(STATS), dtype=torch.float64)
    core.implicit_step(
        system,
        _pointers(**inputs),
        _options(method, rtol, atol, max_iters),
        y.shape[0],
        x.data_ptr(),
        stats.data_ptr(),
        num_threads,
    )
    _notify("step", stats)
    _report(
        stats,
        "implicit step",
        "halve dt, raise max_iters, or loosen rtol (or set atol) where rounding forbids less",
        on_failure,
    )
    return x, stats


@soft_step.register_fake
def _(y, *args):
    return torch.empty_like(y), y.new_empty(y.shape[0], len(STATS))


@torch.library.custom_op("diffsim::soft_step_vjp", mutates_args=())
def soft_step_vjp(
    grad_x: Tensor,
    x: Tensor,
    y: Tensor,
    force: Tensor,
    target: Tensor,
    inertia: Tensor,
    w_mu: Tensor,
    w_vol: Tensor,
    fibre_stiffness: Tensor,
    activation: Tensor,
    damp_mu: Tensor,
    damp_lambda: Tensor,
    x_frame: Tensor,
    x_velocity: Tensor,
    handle: int,
    method: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> list[Tensor]:
    """Adjoint of :func:`soft_step`; gradients in the order of ``_GRADIENTS``, then stats."""
    ctx = context(handle)
    inputs = {
        "y": y,
        "force": force,
        "target": target,
        "w_mu": w_mu,
        "w_vol": w_vol,
        "fibre_stiffness": fibre_stiffness,
        "activation": activation,
        "damp_mu": damp_mu,
        "damp_lambda": damp_lambda,
        "x_frame": x_frame,
        "x_velocity": x_velocity,
    }
    batch = y.shape[0]
    grad_x = grad_x.contiguous()
    _require_sizes(ctx, batch, {**inputs, "inertia": inertia, "x": x, "grad_x": grad_x})
    system = ctx.system(inertia, inputs, num_threads)
    grads = _gradient_buffers({**inputs, "inertia": inertia}, batch)
    stats = torch.zeros(batch, len(STATS), dtype=torch.float64)
    core.implicit_step_adjoint(
        system,
        _pointers(**inputs),
        _options(method, rtol, 0.0, max_iters),
        batch,
        x.data_ptr(),
        grad_x.data_ptr(),
        _pointers(**grads),
        stats.data_ptr(),
        num_threads,
    )
    _notify("adjoint", stats)
    _report(stats, "adjoint solve", "loosen adjoint_rtol or raise max_iters", on_failure)
    return [*_sum_shared(grads), stats]


# Inputs with a gradient, and whether they are shared by the batch.
_GRADIENTS = {
    "y": False,
    "force": False,
    "target": False,
    "inertia": True,
    "w_mu": True,
    "w_vol": True,
    "fibre_stiffness": True,
    "activation": False,
    "damp_mu": True,
    "damp_lambda": True,
    "x_frame": False,
    "x_velocity": False,
}


def _gradient_buffers(inputs: dict[str, Tensor], batch: int) -> dict[str, Tensor]:
    """Zeroed outputs; those of shared parameters get a batch axis, summed afterwards in order."""
    return {
        name: inputs[name].new_zeros((batch, *inputs[name].shape) if shared else inputs[name].shape)
        for name, shared in _GRADIENTS.items()
        if name in inputs
    }


def _sum_shared(grads: dict[str, Tensor]) -> list[Tensor]:
    return [
        (g[0].clone() if g.shape[0] == 1 else g.sum(0)) if _GRADIENTS[name] else g
        for name, g in grads.items()
    ]


@soft_step_vjp.register_fake
def _(grad_x, x, y, force, target, inertia, w_mu, w_vol, fs, act, dm, dl, xf, xv, *args):
    like = [y, force, target, inertia, w_mu, w_vol, fs, act, dm, dl, xf, xv]
    return [*(torch.empty_like(t) for t in like), y.new_empty(y.shape[0], len(STATS))]


def _step_setup(ctx, inputs, output):
    y, force, target, _guess, inertia, *rest = inputs
    ctx.save_for_backward(output[0], y, force, target, inertia, *rest[:8])
    ctx.handle, ctx.method, *_, ctx.num_threads, ctx.on_failure, ctx.rtol, ctx.max_iters = rest[8:]
    ctx.owner = context(ctx.handle)  # the graph keeps the prepared solver, if its body is deleted
    ctx.mark_non_differentiable(output[1])


def _step_backward(ctx, grad_x, _grad_stats):
    # H z = dL/dx, then dL/dp = -z . d(grad g)/dp (thesis eqs. 4.9, 4.10): one solve for all inputs.
    x, y, force, target, inertia, *rest = ctx.saved_tensors
    *grads, _stats = soft_step_vjp(
        grad_x,
        x,
        y,
        force,
        target,
        inertia,
        *rest,
        ctx.handle,
        ctx.method,
        ctx.rtol,
        ctx.max_iters,
        ctx.num_threads,
        ctx.on_failure,
    )
    g_y, g_force, g_target, *others = grads
    return g_y, g_force, g_target, None, *others, *([None] * 9)


soft_step.register_autograd(_step_backward, setup_context=_step_setup)


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
    _require_sizes(ctx, x.shape[0], {**inputs, "x": x})
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
    return _pointers(
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
    _require_sizes(ctx, batch, {**inputs, "x": x, "z": z})
    grads = _gradient_buffers(inputs, batch)
    grad_x = torch.empty_like(x)
    for k in range(batch):
        core.elastic_gradient_adjoint(
            ctx.pattern,
            _item(k, **inputs),
            x[k].data_ptr(),
            z[k].data_ptr(),
            grad_x[k].data_ptr(),
            _pointers(**{name: g[k] if g.numel() else g for name, g in grads.items()}),
            num_threads,
        )
    return [grad_x, *_sum_shared(grads)]


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
