"""The clamped beam: the described body of the published study, as a rung of the ladder changes it.

The beam starts straight, at rest and unstrained, as published; gravity acts along the model's -z.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.data import Channel, Run, Study
from diffsim.identify import Numerics
from diffsim.mesh import HexMesh
from diffsim.systems import setup_of
from diffsim.systems.soft_body import SoftScene
from examples.data.beam import TIP_MARKERS, BeamGeometry
from examples.demo.published import described_body

Array = NDArray[np.float64]
Tick = Callable[[], None]

WEIGHT_AS = ("force", "mass")
CHANNELS = {f"tip_{axis}": {"markers": list(TIP_MARKERS), "axis": axis} for axis in "xyz"}
WIDE = {"percent": 30}  # what is identified here by gradient needs no prior


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Options of the simulated release, apart from what is identified.

    Attributes:
        cells: Elements along, across and up the bar.
        poissons_ratio: Poisson's ratio of the material [-].
        integrator, dt_s: Integrator and time step [s], see :class:`diffsim.soft.SoftBody`.
        weight_as: A hanging weight is a constant ``force`` (published) or a ``mass`` on the
            upper edge of the tip face.
        rtol: Relative tolerance of every time step's solution [-].
    """

    cells: tuple[int, int, int] = (20, 4, 4)
    poissons_ratio: float = 0.45
    integrator: str = "implicit_euler"
    dt_s: float = 1e-2
    weight_as: str = "force"
    rtol: float = 1e-5

    def __post_init__(self) -> None:
        if self.weight_as not in WEIGHT_AS:
            raise ValueError(f"weight_as must be one of {WEIGHT_AS}, got {self.weight_as!r}")

    def changed(self, **changes: Any) -> Setup:
        """A copy with some entries replaced."""
        return replace(self, **changes)


@dataclass(frozen=True)
class Release:
    """A simulated release of the bar."""

    time_s: Array  # times of the samples after the release, (N,) [s]
    tip_m: Tensor  # (N, 3) displacement of the mean tip marker [m]; carries the gradient
    # (N, num_nodes, 3) places of the kept nodes, without gradient; None: not kept
    nodes_m: Tensor | None = None


class Beam:
    """One bar on one mesh; every method is differentiable in the parameters.

    Parameters are a mapping with ``youngs_modulus`` [Pa] and, where there is damping,
    ``rayleigh_beta`` [s] and ``rayleigh_alpha`` [1/s].

    Args:
        bar: Size and material of the bar.
        setup: Numerics and the meaning of the weight.
        load_kg: Mass that hangs from the tip.
    """

    def __init__(self, bar: BeamGeometry, setup: Setup, load_kg: float = 0.0):
        self.setup = setup
        times, fact = np.array([0.0, 1.0]), {"load_kg": load_kg}
        self._run = Run("release", times, np.zeros((2, 3)), {}, "release", setup=fact)
        channels = tuple(Channel(name, "m", "position") for name in CHANNELS)
        model = _changed_body(bar, setup, load_kg)
        study = Study("beam", "soft_body", channels, (self._run,), model=model)
        self._model = setup_of(study).model

    @property
    def mesh(self) -> HexMesh:
        """The bar's mesh at rest."""
        mesh = self._scene({}).body.mesh
        assert isinstance(mesh, HexMesh)
        return mesh

    def sag(self, parameters: Mapping[str, Tensor | float]) -> Tensor:
        """Static sag of the mean tip marker, positive down, 0-d [m]."""
        scene = self._scene(parameters).changed(start="equilibrium")
        state = scene.initial_state(None, scene.body.physics(**scene.parameters))
        return -_tip(scene, state.x)[2]

    def release(
        self,
        parameters: Mapping[str, Tensor | float],
        until_s: float,
        *,
        tick: Tick | None = None,
        keep_nodes: Tensor | None = None,
    ) -> Release:
        """Let go of the straight beam at t = 0.

        Args:
            parameters: Values of the bar's parameters by name, as the class lists them.
            until_s: Time that is simulated after the release [s].
            tick: Called after every step; may raise to stop.
            keep_nodes: Node indices whose places are returned, too.
        """
        num_steps = int(np.ceil(until_s / self.setup.dt_s - 1e-9))
        scene, nodes = self._scene(parameters), list[Tensor]()

        def observe(x: Tensor) -> Tensor:
            if tick is not None:
                tick()
            if keep_nodes is not None:
                nodes.append(x.detach()[keep_nodes])
            return _tip(scene, x)

        tip = scene.changed(observe=observe).motion(num_steps)
        return Release(
            time_s=np.arange(num_steps + 1, dtype=np.float64) * self.setup.dt_s,
            tip_m=tip,
            nodes_m=torch.stack(nodes) if nodes else None,
        )

    def _scene(self, parameters: Mapping[str, Tensor | float]) -> SoftScene:
        known = {p.name: torch.tensor(p.value, dtype=torch.float64) for p in self._model.base}
        given = {n: torch.as_tensor(v, dtype=torch.float64) for n, v in parameters.items()}
        scene = self._model.build(known | given, self._run, Numerics())
        assert isinstance(scene, SoftScene)
        return scene


def _tip(scene: SoftScene, x: Tensor) -> Tensor:
    """Displacement of the mean tip marker from the held state, (3,) [m]."""
    assert scene.rest_places is not None
    return (scene.observe(x) - scene.rest_places).view(-1, 3).mean(0)


def _changed_body(bar: BeamGeometry, setup: Setup, load_kg: float) -> dict[str, Any]:
    """The published study's body as the demo changes it: nothing of the hand, clamp and cameras."""
    body = described_body()
    weight = {"acts_as": "weight" if setup.weight_as == "force" else "mass", "share": 1.0}
    length = bar.length_m
    size = [length, bar.width_m, bar.height_m]
    return body | {
        "body": {"bar": {"size": size, "corner": [-length, 0, 0], "cells": list(setup.cells)}},
        "material": {
            "youngs_modulus": {"value": bar.youngs_modulus_published_Pa, **WIDE},
            "poissons_ratio": setup.poissons_ratio,
            "density": bar.density_kg_m3,
            "rayleigh_beta": {"value": 0.0, "sd": 1e-3},
            "rayleigh_alpha": {"value": 0.0, "sd": 1.0},
        },
        "fixed": [{"x": -length}],
        "gravity": {"vector": [0.0, 0.0, -bar.gravity_m_s2]},
        "masses": [load | weight for load in body["masses"]] if load_kg > 0 else [],
        "markers": {
            name: {"at": list(bar.marker_place_m[name]), "carried_by": {"x": 0}}
            for name in TIP_MARKERS
        },
        "channels": CHANNELS,
        "camera": {},
        "clock": {},
        "support": None,
        "start": {"shape": "rest"},
        # the mesh's own stiffness is part of the story: it is not corrected here
        "numerics": {
            "time_step": setup.dt_s,
            "integrator": setup.integrator,
            "tolerance": setup.rtol,
            "correct_mesh": False,
        },
    }


def timoshenko_sag(bar: BeamGeometry, youngs_modulus: float, poissons_ratio: float) -> float:
    """Tip sag of a clamped Timoshenko beam under its own weight [m].

    q L^4 / (8 E I) + q L^2 / (2 kappa G A), kappa = 10 (1 + nu) / (12 + 11 nu) (Cowper 1966). Its
    clamped section is free to contract sideways, which a clamped solid is not.
    """
    area = bar.width_m * bar.height_m
    inertia = bar.width_m * bar.height_m**3 / 12.0
    load = bar.density_kg_m3 * area * bar.gravity_m_s2
    nu = poissons_ratio
    shear = youngs_modulus / (2.0 * (1.0 + nu)) * 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu) * area
    length = bar.length_m
    return load * length**4 / (8.0 * youngs_modulus * inertia) + load * length**2 / (2.0 * shear)
