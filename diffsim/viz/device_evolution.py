"""Change of a design from the best random one to the optimum (thesis fig. 4-24)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.optional import optional
from diffsim.stokes.devices.device import Device, quiet
from diffsim.stokes.devices.optimum import Optimum
from diffsim.viz.figures import INK, new_figure, save
from diffsim.viz.flow import SPEED


def milestones(optimum: Optimum, count: int = 6) -> list[tuple[int, float, Tensor]]:
    """Designs on the way, each better than all before.

    Those of the coarse grid that led to the result come first, in its unit.

    Args:
        optimum: Result of the optimization with all designs on the way.
        count: Largest number of designs, 2 or more; the first and the last are always among them.

    Returns:
        Evaluation (from 1), normalized loss, design (num_parameters,).
    """
    if count < 2:
        raise ValueError(f"count must be at least 2, got {count}")
    losses, designs = [optimum.evaluation_losses], [optimum.evaluations]
    if optimum.coarse is not None:
        descent = optimum.coarse.descents[int(optimum.coarse.fine_losses.argmin())]
        losses.insert(0, descent.losses / optimum.coarse.unit_loss)
        designs.insert(0, descent.designs)
    improved: list[tuple[int, float, Tensor]] = []
    before = 0
    for stage, path in zip(losses, designs, strict=True):
        least = np.inf  # grids are compared with themselves only
        for k, (loss, x) in enumerate(zip(stage.tolist(), path, strict=True)):
            if loss < least:
                least = loss
                improved.append((before + k + 1, loss, x))
        before += len(stage)
    chosen = np.unique(np.linspace(0, len(improved) - 1, count).round().astype(int))
    return [improved[k] for k in chosen]


def draw_shapes(device: Device, optimum: Optimum, path: str | Path, count: int = 6) -> Path:
    """Walls of designs on the way, light to dark, at every height that the device's pictures show.

    Args:
        device: Device that was optimized.
        optimum: Result of the search for the device.
        path: PNG file to be written.
        count: Largest number of designs that are drawn.
    """
    plt_colors = optional("matplotlib.colors", purpose="the picture of a device")
    shown = milestones(optimum, count)
    heights = device.slices if device.grid.dim == 3 else (None,)
    panels = [(k, height) for k in range(len(device.states)) for height in heights]
    size = device.grid.size
    width = 3.2 * len(panels)
    figure, axes = new_figure(
        1, len(panels), width=width + 1.8, height=3.2 * size[1] / size[0] + 0.4, squeeze=False
    )
    figure.set_facecolor("white")
    ramp = plt_colors.LinearSegmentedColormap.from_list("evaluations", SPEED[1:])
    x = np.linspace(0.0, size[0], device.grid.node_shape[0])
    y = np.linspace(0.0, size[1], device.grid.node_shape[1])
    handles: list[Any] = []
    lines = optional("matplotlib.lines", purpose="the picture of a device")
    for i, (number, loss, design) in enumerate(shown):
        share = i / max(len(shown) - 1, 1)
        color, weight = ramp(share), 0.9 + 1.1 * (i == len(shown) - 1)
        label = f"{number}: {loss:.2g}"
        handles.append(lines.Line2D([], [], color=color, lw=weight, label=label))
        with torch.no_grad(), quiet():
            levels = [device.level_set(design, k).numpy() for k in range(len(device.states))]
        for ax, (k, height) in zip(axes[0], panels, strict=True):
            phi = levels[k]
            if height is not None:
                phi = phi[:, :, round(height * device.grid.shape[2])]
            ax.contour(x, y, phi.T, levels=[0.0], colors=[color], linewidths=weight)
    for ax, (k, height) in zip(axes[0], panels, strict=True):
        parts = [device.states[k].name] if len(device.states) > 1 else []
        parts += [f"height {height:g}"] if len(heights) > 1 else []
        ax.set_title(", ".join(parts), fontsize=9, color=INK)
        ax.grid(False)
        ax.set(xlim=(0, size[0]), ylim=(0, size[1]), xticks=[], yticks=[], aspect="equal")
        for side in ax.spines.values():
            side.set(visible=True, color=INK)
    figure.legend(
        handles=handles, title="evaluation: loss", loc="outside right center", frameon=False,
        fontsize=8.5, title_fontsize=9,
    )  # fmt: skip
    return save(figure, path, dpi=110)
