"""Rigs of other people's simulators (``labs.outside``), with what is hidden at any size.

Their packages are imported when a recording is made; a rig whose package is not installed is left
out and named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from labs.outside.arms import arm
from labs.outside.case import Maker
from labs.outside.flights import flight
from labs.outside.mechanisms import SHARP, cart, pendulum
from labs.outside.rods import rod
from labs.rates.rig import Cause, Recorded, Size

#: From a size to what a maker of ``labs.outside`` takes.
Hide = Callable[[float], Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class ForeignRig:
    """A machine in somebody else's simulator."""

    name: str  # of the machine
    package: str  # package of the simulator
    make: Callable[..., Any]  # maker of its recordings
    # causes by the library's names, and how the maker hides them
    hides: Mapping[str, tuple[Cause, Hide]]
    setup_file: Path | None = None
    disturbances: tuple[str, ...] = ()

    @property
    def causes(self) -> Mapping[str, Cause]:
        """What it can hide."""
        return {name: cause for name, (cause, _) in self.hides.items()}

    def record(self, seed: int, hidden: Mapping[str, Size], disturbance: str) -> Recorded:
        """As the maker does."""
        options: dict[str, Any] = {}
        for name, size in hidden.items():
            options |= self.hides[name][1](size[0])
        made = partial(self.make, **options)
        maker: Maker = made
        case = maker(seed)
        return Recorded(case.study, case.clean, case.base)


def _rubbing(size: float) -> Mapping[str, Any]:
    return {"joint": f'frictionloss="{size}" {SHARP}'}


def _sprung(size: float) -> Mapping[str, Any]:
    return {"joint": f'stiffness="{size}"'}


def _limited(size: float) -> Mapping[str, Any]:
    most = 3.0 * (1.0 - size)
    limits = f'ctrllimited="true" ctrlrange="{-most} {most}"'
    return {"actuator": f'<motor name="motor" joint="rail" {limits}/>'}


def _hit(size: float) -> Mapping[str, Any]:
    """A ball of another strength hits the cart in every run."""

    def push(model: Any, data: Any, time: float) -> None:
        data.qfrc_applied[0] = size * np.exp(-(((time - 1.3) / 0.05) ** 2))

    return {"push": push}


def _draggy(size: float) -> Mapping[str, Any]:
    return {"changes": dict.fromkeys(("c_Dx", "c_Dy", "c_Dz"), size)}


def _taut(size: float) -> Mapping[str, Any]:
    """A spring across the rail, which gets stiffer as it is stretched."""
    tendon = f'<tendon><spatial stiffness="{size}" springlength="0.3">'
    return {"more": tendon + '<site site="hook"/><site site="wall"/></spatial></tendon>'}


OUTSIDE = (
    ForeignRig(
        "mujoco_pendulum",
        "mujoco",
        pendulum,
        {
            "dry_friction_at_hinge": (Cause(0.01), _rubbing),
            "added_spring_at_hinge": (Cause(0.1), _sprung),
            "lag": (Cause(0.01, names=("lag",)), lambda s: {"lag": s}),
            "delay": (Cause(0.01, names=("delay",)), lambda s: {"late_s": s}),
        },
    ),
    ForeignRig(
        "mujoco_cart",
        "mujoco",
        cart,
        {
            "constant_force": (
                Cause(0.02, names=("constant_force", "command_offset"), sized=False),
                lambda s: {"gx": s},
            ),
            "dry_friction": (Cause(0.05), _rubbing),
            "lag": (
                Cause(0.01, names=("lag", "sensor_lag")),
                lambda s: {"lag": s},
            ),
            "saturation": (Cause(0.3, sized=False, most=0.8), _limited),
            "cubic_stiffness": (Cause(20.0, sized=False), _taut),
            "hit": (Cause(0.5, known=False), _hit),
        },
    ),
    ForeignRig(
        "mujoco_arm",
        "mujoco",
        arm,
        {
            "dry_friction_at_elbow": (Cause(0.01), _rubbing),
            "added_spring_at_elbow": (Cause(0.1), _sprung),
            "lag_of_elbow": (Cause(0.02), lambda s: {"lag": s}),
        },
    ),
    ForeignRig(
        "elastica_rod",
        "elastica",
        rod,
        {
            "delay": (Cause(0.02), lambda s: {"late_s": s}),
            "square_drag_at_tip": (
                Cause(1.0, names=("square_drag",), sized=False),
                lambda s: {"drag": s},
            ),
        },
    ),
)
FOREIGN_FLIGHT = (
    ForeignRig(
        "rotorpy_quadrotor",
        "rotorpy",
        flight,
        {
            "parasitic_drag": (Cause(0.01), _draggy),
            "weak_rotor_2": (Cause(0.02, most=0.3), lambda s: {"weak": (1, s)}),
            "rotor_speed_drag": (Cause(2e-5, sized=False), lambda s: {"changes": {"k_d": s}}),
        },
    ),
)
