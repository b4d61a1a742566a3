"""A generic smooth pressure in the branches of a channel network: a cause without a form."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.flow_network.network_model import NetworkScene
from diffsim.systems.signals import straight


class _UnknownPressure(Effect):
    """Pressure drop in every branch [Pa], straight lines between knots of time.

    Components: knots fastest, then the branches.
    """

    name, family, kind, unit, typical = "unknown_pressure", "unknown", "force", "Pa", 1.0
    also_looks_like = ("anything",)

    def __init__(self, num_knots: int, until_s: float, num_outlets: int):
        self._shape, self._spacing = (num_outlets, num_knots), until_s / (num_knots - 1)

    def apply(self, scene: NetworkScene, size: Tensor, run: Run) -> NetworkScene:
        time = torch.from_numpy(run.time_s - run.time_s[0])
        drop = straight(size.reshape(self._shape).T, self._spacing, time)
        return dataclasses.replace(  # every sample is a level of its own
            scene,
            drive=scene.drive[scene.level],
            back_pressure=scene.back_pressure[scene.level] + drop,
            level=torch.arange(len(time)),
        )


def unknown_pressure(num_knots: int, until_s: float, num_outlets: int) -> Effect:
    """The effect with ``num_knots`` >= 2 knots from 0 to ``until_s`` [s] for every outlet."""
    names = tuple(f"outlet_{i + 1}_{k}" for i in range(num_outlets) for k in range(num_knots))
    made = type("UnknownPressure", (_UnknownPressure,), {"components": names})
    effect: Effect = made(num_knots, until_s, num_outlets)
    return effect
