"""A generic smooth pressure in the branches of a channel network: a cause without a form."""

from __future__ import annotations

import dataclasses
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.interpolation import straight
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.flow_network.network_model import NetworkScene


def _with_pressure(
    scene: NetworkScene, size: Tensor, run: Run, *, shape: tuple[int, int], spacing: float
) -> NetworkScene:
    """Pressure drop in every branch [Pa], straight lines between knots of time.

    Components: knots fastest, then the branches.
    """
    time = torch.from_numpy(run.time_s - run.time_s[0])
    drop = straight(size.reshape(shape).T, spacing, time)
    return dataclasses.replace(  # every sample is a level of its own
        scene,
        drive=scene.drive[scene.level],
        back_pressure=scene.back_pressure[scene.level] + drop,
        level=torch.arange(len(time)),
    )


def unknown_pressure(num_knots: int, until_s: float, num_outlets: int) -> Effect:
    """The effect with ``num_knots`` >= 2 knots from 0 to ``until_s`` [s] for every outlet."""
    return Effect(
        name="unknown_pressure",
        form="Pressure drop in every branch [Pa], straight lines between knots of time.",
        family="unknown",
        kind="force",
        unit="Pa",
        typical=1.0,
        also_looks_like=("anything",),
        apply=partial(
            _with_pressure, shape=(num_outlets, num_knots), spacing=until_s / (num_knots - 1)
        ),
        components=tuple(
            f"outlet_{i + 1}_{k}" for i in range(num_outlets) for k in range(num_knots)
        ),
    )
