"""A batch of episodes in which every member is steered by parameters of its own."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn
from torch.func import functional_call, vmap

from diffsim.envs.rollout import Controller


def steer_members(controller: nn.Module, parameters: Mapping[str, Tensor]) -> Controller:
    """A controller whose member k of the batch has parameters[k].

    Args:
        controller: Whose call it is, and whose buffers and other parameters all members share.
        parameters: By name, (batch, ...) each; differentiable.
    """
    buffers = dict(controller.named_buffers())

    def steer(observation: Tensor, step: int) -> Tensor:
        def one(weights: Mapping[str, Tensor], seen: Tensor) -> Tensor:
            out: Tensor = functional_call(controller, {**buffers, **weights}, (seen, step))
            return out

        actions: Tensor = vmap(one)(dict(parameters), observation)
        return actions

    return steer
