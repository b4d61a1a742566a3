"""Flows of designs side by side, and how the loss fell."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim._files import write_bytes_atomic
from diffsim.stokes.devices.device import Device, quiet
from diffsim.stokes.devices.optimise import Optimum
from diffsim.stokes.field import FlowField
from diffsim.viz._require import optional

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SOLID, _INK, _ACCENT = "#c9ced6", "#22303c", "#c8452f"


def draw(device: Device, optimum: Optimum, path: str | Path) -> Path:
    """Best random and optimised design, each inlet case, position and height; and the loss.

    Args:
        device: The device.
        optimum: Its optimum.
        path: PNG to write.
    """
    plt: Any = optional("matplotlib.pyplot", purpose="the picture of a device")
    designs = {
        f"best of {len(optimum.samples)} random designs": optimum.start,
        "optimised": optimum.x,
    }
    first = optimum.evaluation_losses[0]
    losses = [float(first), optimum.loss]
    panels = {name: _panels(device, x) for name, x in designs.items()}
    columns = len(next(iter(panels.values())))
    size = device.grid.size
    panel = 3.4 if columns == 1 else 2.6
    width = columns * (panel + 0.1) + 1.3
    height = 2.0 * panel * size[1] / size[0] + (0.4 if columns == 1 else 0.9)
    figure = plt.figure(figsize=(width + 3.6, height), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(width, 3.6))
    axes = left.subplots(2, columns, squeeze=False)
    top = max(float(p["top"]) for group in panels.values() for p in group.values())
    image = None
    for row, ((name, group), loss) in enumerate(zip(panels.items(), losses, strict=True)):
        for k, (title, shown) in enumerate(group.items()):
            image = _panel(axes[row, k], shown, top)
            if title:
                axes[row, k].set_title(title, fontsize=9, color=_INK)
        axes[row, 0].set_ylabel(f"{name}\nloss {loss:.2g}", fontsize=10, color=_INK)
    assert image is not None
    bar = left.colorbar(image, ax=axes, shrink=0.7, pad=0.02)
    planar = "" if device.grid.dim == 2 else " in the plane"
    bar.set_label(f"speed{planar} [inlet speeds]", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    _history(right.subplots(), device, optimum)
    content = BytesIO()
    figure.savefig(content, dpi=110, format="png")
    plt.close(figure)
    return write_bytes_atomic(path, content.getvalue())


def _panels(device: Device, x: Tensor) -> dict[str, dict[str, Any]]:
    """Title to what a panel shows, for all states, cases and heights."""
    out = {}
    for k, state in enumerate(device.states):
        with torch.no_grad(), quiet():
            field = device.solve(x, k)
        for c, case in enumerate(device.cases):
            for height in device.slices if device.grid.dim == 3 else (None,):
                parts = [state.name] if len(device.states) > 1 else []
                parts += [case] if len(device.cases) > 1 else []
                parts += [f"height {height:g}"] if len(device.slices) > 1 else []
                out[", ".join(parts)] = _slice(field, c, height)
    return out


def _slice(field: FlowField, case: int, height: float | None) -> dict[str, Any]:
    velocity, phi = field.velocity[case], field.phi
    if height is not None:
        k = round(height * field.grid.shape[2])
        velocity, phi = velocity[:, :, k], phi[:, :, k]
    v = velocity[..., :2].numpy().copy()
    speed = np.linalg.norm(v, axis=-1)
    inside = speed[phi.numpy() > 0]
    return {
        "x": np.linspace(0.0, field.grid.size[0], v.shape[0]),
        "y": np.linspace(0.0, field.grid.size[1], v.shape[1]),
        "velocity": v,
        "speed": speed,
        "phi": phi.numpy(),
        "top": np.quantile(inside, 0.995) if inside.size else 0.0,
    }


def _panel(axes: Axes, panel: dict[str, Any], top: float) -> Any:
    x, y, v, phi = (panel[k] for k in ("x", "y", "velocity", "phi"))
    image = axes.imshow(
        panel["speed"].T,
        origin="lower",
        extent=(x[0] - 0.5 * x[1], x[-1] + 0.5 * x[1], y[0] - 0.5 * y[1], y[-1] + 0.5 * y[1]),
        cmap="viridis",
        vmin=0.0,
        vmax=top,
        interpolation="bilinear",
    )
    axes.contourf(x, y, -phi.T, levels=[0.0, np.inf], colors=[_SOLID])
    axes.contour(x, y, phi.T, levels=[0.0], colors=[_INK], linewidths=1.2)
    moving = (phi > 0) & (panel["speed"] > 1e-3 * top)
    flow = np.where(moving[..., None], v, np.nan)
    if moving.any():
        axes.streamplot(
            x, y, flow[..., 0].T, flow[..., 1].T,
            color="white", density=0.9, linewidth=0.6, arrowsize=0.7,
        )  # fmt: skip
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), xticks=[], yticks=[], aspect="equal")
    return image


def _history(axes: Axes, device: Device, optimum: Optimum) -> None:
    """Random designs as dots, L-BFGS as a line."""
    values = optimum.evaluation_losses.numpy()
    best = np.minimum.accumulate(values)
    zero = np.zeros(len(optimum.sample_losses))
    axes.plot(
        zero, optimum.sample_losses.numpy(), "o", ms=4, color=_SOLID, mec=_INK, mew=0.6,
        label="random designs, mean 1",
    )  # fmt: skip
    number = 1 + np.arange(len(values))
    shown = np.where(np.isfinite(values), values, np.nan)
    axes.plot(number, shown, ".", ms=4, color=_ACCENT, alpha=0.5)
    axes.plot(number, best, color=_ACCENT, lw=1.6, label="L-BFGS, best so far")
    reference = device.reference.get("loss")
    if reference:
        axes.axhline(reference, color=_INK, lw=0.8, ls="--", label=f"thesis {reference:.2g}")
    axes.set_yscale("log")
    axes.set_xlabel("evaluation of loss and gradient", fontsize=9)
    axes.set_ylabel("normalised loss", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)


def numbers(device: Device, optimum: Optimum) -> Mapping[str, float | str]:
    """What a run found, for tables and files."""
    return {
        "loss": optimum.loss,
        "loss of best random design": float(optimum.sample_losses.min()),
        "loss in the thesis": device.reference.get("loss", float("nan")),
        "unit loss": optimum.unit_loss,
        "random designs": len(optimum.samples),
        "rejected random designs": optimum.num_rejected,
        "evaluations": len(optimum.evaluation_losses),
        "CPU seconds per loss and gradient": optimum.seconds,
        "wall seconds in the thesis": device.reference.get("seconds", float("nan")),
        "message": optimum.message,
    }
