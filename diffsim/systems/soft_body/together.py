"""Scenes of one run that differ by their commands alone, simulated in one rollout.

A scan over sizes of a dead band or a backlash asks for many such scenes. A step of a batch costs
little more than one of a single body as long as bodies are small.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffsim import soft
from diffsim.systems.soft_body.line import same_surroundings
from diffsim.systems.soft_body.scene import SoftScene


def simulate_together(scenes: Sequence[Any]) -> list[Tensor]:
    """Predictions of scenes, (num_samples, num_channels) each; those alike in one rollout.

    Args:
        scenes: Scenes of one run, of any kind.
    """
    out: dict[int, Tensor] = {}
    waiting = list(range(len(scenes)))
    while waiting:
        first = scenes[waiting[0]]
        group = [k for k in waiting if k == waiting[0] or _are_alike(first, scenes[k])]
        if len(group) == 1:
            out[group[0]] = first.simulate()
        else:
            out |= zip(group, _simulate_group([scenes[k] for k in group]), strict=True)
        waiting = [k for k in waiting if k not in out]
    return [out[k] for k in range(len(scenes))]


def _are_alike(a: Any, b: Any) -> bool:
    """Whether two scenes differ by their commands and by what is read off them alone."""
    if type(a) is not SoftScene or type(b) is not SoftScene or a.body is not b.body:
        return False
    if any(s.makers or s.water or s.obstacles or s.pressurize is not None for s in (a, b)):
        return False
    if not (a.is_commanded and b.is_commanded) or not a.body.muscles.num_muscles:
        return False
    settings = [(s.start, s.num_steps(), tuple(s.relaxed)) for s in (a, b)]
    return settings[0] == settings[1] and not a.relaxed and same_surroundings(a, b, None)


def _simulate_group(scenes: Sequence[SoftScene]) -> list[Tensor]:
    scene = scenes[0]
    num_steps, physics = scene.num_steps(), scene.body.physics(**scene.parameters)
    every = [s.activations(num_steps) for s in scenes]
    activations = torch.stack([a for a in every if a is not None], dim=1)
    starts = [s.initial_state(a, physics) for s, a in zip(scenes, activations[0], strict=True)]
    state = soft.State(torch.stack([s.x for s in starts]), torch.stack([s.v for s in starts]))

    def observe(now: soft.State) -> Tensor:
        return torch.stack([s.observe(x) for s, x in zip(scenes, now.x, strict=True)])

    observed = soft.rollout(
        scene.body,
        state,
        num_steps,
        activation=lambda k, now: activations[k],
        physics=physics,
        keep=observe,
    ).x
    return [s.channels(observed[:, k]) for k, s in enumerate(scenes)]
