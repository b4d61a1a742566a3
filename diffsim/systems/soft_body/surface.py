"""The surface of a soft body in motion, at the sample times of its run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.scene import Instruments
from diffsim.core.memo import Memo
from diffsim.identify.shape import MovingShape
from diffsim.mesh import surface_triangles
from diffsim.systems.soft_body.quasi_static import PosedScene
from diffsim.systems.soft_body.scene import SoftScene


def surface_of(scene: SoftScene) -> MovingShape:
    """One more simulation of the scene, in which the nodes of the surface are observed.

    Args:
        scene: A run with its effects; what they change in cameras and channels is left out.
    """
    faces = surface_triangles(scene.body.mesh).faces
    used, local = torch.unique(faces, return_inverse=True)

    def observe(x: Tensor) -> Tensor:
        return x[..., used, :].flatten(-2)

    clocks = Instruments(scene.instruments.clocks)
    bare = scene.changed(
        observe=observe, place_maps=(), output_maps=(), rest_places=None, instruments=clocks
    )
    if isinstance(bare, PosedScene):
        bare = replace(bare, kept=Memo(1))  # what is kept shows markers
    places = bare.simulate().detach().numpy()
    return MovingShape(
        triangles=local.reshape(-1, 3).numpy(),
        nodes_m=np.ascontiguousarray(places.reshape(len(places), -1, 3)),
        closed=True,
    )
