"""Random and optimized design side by side (thesis figs. 4-22 to 4-25), and how the loss fell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.optional import optional
from diffsim.stokes.devices.device import Device, quiet
from diffsim.stokes.devices.optimum import Optimum
from diffsim.stokes.field import FlowField
from diffsim.viz.figures import save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SOLID, _INK, _ACCENT = "#c9ced6", "#22303c", "#c8452f"
_BOTH = "both, half each"
_MAX_ANGLE = 90.0  # of the color scale [degrees]
_REST = 1e-3  # of the greatest speed: slower fluid counts as resting


def draw(device: Device, optimum: Optimum, path: str | Path) -> Path:
    """Best random and optimized design, each inlet case, position and height; and the loss.

    Two inlets have a third panel, both at half speed: by linearity the mean of the other two. Where
    the device is about directions, colors are angles to those wanted, else speeds.

    Args:
        device: Device that was optimized.
        optimum: Result of the search for the device.
        path: PNG file to be written.
    """
    plt: Any = optional("matplotlib.pyplot", purpose="the picture of a device")
    random = optimum.samples[int(optimum.sample_losses.argmin())]
    designs = {f"best of {len(optimum.samples)} random": random, "optimized": optimum.x}
    rows = {name: _flows(device, x) for name, x in designs.items()}
    panels = {name: _panels(device, fields) for name, fields in rows.items()}
    columns = len(next(iter(panels.values())))
    size = device.grid.size
    panel = 3.4 if columns == 1 else 2.6 if columns < 4 else 2.2
    width = columns * (panel + 0.1) + 1.3
    height = 2.0 * panel * size[1] / size[0] + (0.4 if columns == 1 else 0.9)
    figure = plt.figure(figsize=(width + 3.6, height), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(width, 3.6))
    axes = left.subplots(2, columns, squeeze=False)
    top = max(float(p["top"]) for group in panels.values() for p in group.values())
    image: Any = None
    for row, (name, group) in enumerate(panels.items()):
        for ax, (title, shown) in zip(axes[row], group.items(), strict=True):
            image = _panel(ax, shown, top)
            ax.set_title(title, fontsize=9, color=_INK)
        loss = _loss(device, rows[name]) / optimum.unit_loss
        axes[row, 0].set_ylabel(f"{name}\nloss {loss:.2g}", fontsize=10, color=_INK)
    _color_bar(left, image, axes, device)
    _history(right.subplots(), device, optimum)
    written = save(figure, path, dpi=110)
    plt.close(figure)
    return written


def _flows(device: Device, x: Tensor) -> list[FlowField]:
    with torch.no_grad(), quiet():
        return [device.solve(x, k) for k in range(len(device.states))]


def _loss(device: Device, fields: list[FlowField]) -> float:
    return sum(float(s.loss(f)) for s, f in zip(device.states, fields, strict=True))


def _panels(device: Device, fields: list[FlowField]) -> dict[str, dict[str, Any]]:
    """Title to what a panel shows, for all states, cases and heights."""
    out = {}
    for state, field in zip(device.states, fields, strict=True):
        for case, velocity, wanted in _cases(device, field):
            for height in device.slices if device.grid.dim == 3 else (None,):
                parts = [state.name] if len(device.states) > 1 else []
                parts += [case] if len(device.cases) > 1 else []
                parts += [f"height {height:g}"] if len(device.slices) > 1 else []
                out[", ".join(parts)] = _slice(field, velocity, height, wanted)
    return out


def _cases(device: Device, field: FlowField) -> list[tuple[str, Tensor, tuple[float, ...] | None]]:
    """Name, velocity (*node_shape, dim), wanted direction of the inlet cases; two have a mean."""
    directions: list[tuple[float, ...] | None] = list(device.directions) or [None] * len(
        device.cases
    )
    out = list(zip(device.cases, field.velocity, directions, strict=True))
    if len(out) == 2:
        first, second = directions
        middle = first and second and tuple(a + b for a, b in zip(first, second, strict=True))
        out.append((_BOTH, field.velocity.mean(0), middle))
    return out


def _slice(
    field: FlowField, velocity: Tensor, height: float | None, wanted: tuple[float, ...] | None
) -> dict[str, Any]:
    phi = field.phi
    if height is not None:
        k = round(height * field.grid.shape[2])
        velocity, phi = velocity[:, :, k], phi[:, :, k]
    v = velocity[..., :2].numpy().copy()
    speed = np.linalg.norm(v, axis=-1)
    inside = speed[phi.numpy() > 0]
    color = speed
    if wanted is not None:
        off = np.arctan2(v[..., 1], v[..., 0]) - np.arctan2(wanted[1], wanted[0])
        moving = speed > _REST * speed.max(initial=0.0)  # resting fluid has no direction
        color = np.where(moving, np.degrees(np.abs(np.angle(np.exp(1j * off)))), np.nan)
    return {
        "x": np.linspace(0.0, field.grid.size[0], v.shape[0]),
        "y": np.linspace(0.0, field.grid.size[1], v.shape[1]),
        "velocity": v,
        "speed": speed,
        "color": color,
        "phi": phi.numpy(),
        "is_angle": wanted is not None,
        "top": np.quantile(inside, 0.995) if inside.size else 0.0,
    }


def _panel(axes: Axes, panel: dict[str, Any], top: float) -> Any:
    x, y, v, phi = (panel[k] for k in ("x", "y", "velocity", "phi"))
    angle = panel["is_angle"]
    image = axes.imshow(
        panel["color"].T,
        origin="lower",
        extent=(x[0] - 0.5 * x[1], x[-1] + 0.5 * x[1], y[0] - 0.5 * y[1], y[-1] + 0.5 * y[1]),
        cmap="coolwarm" if angle else "viridis",
        vmin=0.0,
        vmax=_MAX_ANGLE if angle else top,
        interpolation="bilinear",
    )
    axes.contourf(x, y, -phi.T, levels=[0.0, np.inf], colors=[_SOLID])
    axes.contour(x, y, phi.T, levels=[0.0], colors=[_INK], linewidths=1.2)
    moving = (phi > 0) & (panel["speed"] > _REST * top)
    flow = np.where(moving[..., None], v, np.nan)
    if moving.any():
        axes.streamplot(
            x, y, flow[..., 0].T, flow[..., 1].T,
            color=_INK if angle else "white", density=0.9, linewidth=0.6, arrowsize=0.7,
        )  # fmt: skip
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), xticks=[], yticks=[], aspect="equal")
    return image


def _color_bar(figure: Any, image: Any, axes: Any, device: Device) -> None:
    bar = figure.colorbar(
        image, ax=axes, shrink=0.7, pad=0.02, extend="max" if device.directions else "neither"
    )
    planar = "" if device.grid.dim == 2 else " in the plane"
    label = f"speed{planar} [inlet speeds]"
    if device.directions:
        label = "angle to the direction wanted at the outlet [degrees]"
        bar.set_ticks([0, 15, 30, 45, 60, 75, 90])
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _history(axes: Axes, device: Device, optimum: Optimum) -> None:
    """Random designs as dots, L-BFGS as lines: of the coarse grid gray, then of the device's."""
    coarse = optimum.coarse
    mean = "random designs, mean 1"
    axes.plot(
        np.zeros(len(optimum.sample_losses)), optimum.sample_losses.numpy(),
        "o", ms=4, color=_SOLID, mec=_INK, mew=0.6,
        label=mean if coarse is None else f"{mean} (coarse grid)",
    )  # fmt: skip
    before = 0
    if coarse is not None:
        for k, descent in enumerate(coarse.descents):
            losses = np.minimum.accumulate(descent.losses.numpy()) / coarse.unit_loss
            axes.plot(
                1 + np.arange(len(losses)), losses, color="#8a93a3", lw=1.2,
                label="" if k else "L-BFGS on the coarse grid",
            )  # fmt: skip
        before = len(coarse.descents[int(coarse.fine_losses.argmin())].losses)
    values = optimum.evaluation_losses.numpy()
    number = before + 1 + np.arange(len(values))
    shown = np.where(np.isfinite(values), values, np.nan)
    axes.plot(number, shown, ".", ms=4, color=_ACCENT, alpha=0.5)
    axes.plot(
        number, np.minimum.accumulate(values), color=_ACCENT, lw=1.6, label="L-BFGS, best so far"
    )
    reference = device.reference.get("loss")
    if reference:
        axes.axhline(reference, color=_INK, lw=0.8, ls="--", label=f"thesis {reference:.2g}")
    low, high = axes.get_ylim()
    if high > 3.0 * max(low, 0.0):  # else a logarithmic axis has hardly a label
        axes.set_yscale("log")
    axes.set_xlabel("evaluation of loss and gradient", fontsize=9)
    axes.set_ylabel("normalized loss", fontsize=9)
    axes.tick_params(which="both", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.figure.legend(loc="outside upper center", frameon=False, fontsize=8)
