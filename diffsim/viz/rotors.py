"""Rotor models against their bench tables: curves above, residuals below."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.viz.figures import COLORS, INK, SOFT, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from diffsim.copter.vehicle.fit_rotor import CurveFit, RotorFit

_PANELS = {
    "thrust": ("speed [rad/s]", "thrust [N]"),
    "torque": ("thrust [N]", "torque [N m]"),
    "current": ("thrust [N]", "current [A]"),
    "speed": ("signal [us]", "speed [rad/s]"),
}


def rotor_fit(fit: RotorFit) -> Figure:
    """Measured rows, fitted curves and residuals of thrust, torque, current and speed.

    Args:
        fit: Fit as ``fit_rotor`` returns it.
    """
    kept = "thrust_offset" if fit.model.thrust_offset else "thrust"
    curves = {name: fit.curves[name] for name in _PANELS if name in fit.curves}
    curves["thrust"] = fit.curves[kept]
    figure, axes = new_figure(
        2, len(curves), width=3.4 * len(curves), height=5.0, height_ratios=[2, 1], squeeze=False
    )
    down = fit.table.turning.down
    for column, (name, curve) in enumerate(curves.items()):
        above, below = axes[:, column]
        _rows(above, curve, curve.y, down)
        order = np.argsort(curve.x, kind="stable")
        fitted = (curve.y - curve.residuals)[order]
        if name == "speed":  # one x, two voltages: no single line
            above.plot(curve.x[order], fitted, "_", color=INK, markersize=9)
        else:
            above.plot(curve.x[order], fitted, color=INK, linewidth=1.2)
        _rows(below, curve, curve.residuals, down)
        below.axhline(0.0, color=INK, linewidth=0.8)
        xlabel, ylabel = _PANELS[name]
        above.set_title(f"{ylabel}, rms {curve.rms:.3g}", loc="left", fontsize=9.5, color=INK)
        below.set_xlabel(xlabel, color=SOFT)
        if column == 0:
            below.set_ylabel("measured - fitted", color=SOFT)
    figure.suptitle(fit.table.title, color=INK, fontsize=11)
    return figure


def _rows(ax: Any, curve: CurveFit, y: Any, down: Any) -> None:
    color = COLORS["measured"]
    ax.plot(curve.x[~down], y[~down], "o", color=color, markersize=4)
    ax.plot(curve.x[down], y[down], "v", color=color, markersize=4, markerfacecolor="none")
