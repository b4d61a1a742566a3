"""Adam, without what PyTorch's optimizers load.

The first optimizer of ``torch.optim`` that a process makes imports PyTorch's compiler: one to two
seconds, a fifth of what a copter takes to learn to hover. Thereafter calls of kernels are slower,
too (:mod:`diffsim.core.layer`). A test holds this one against PyTorch's, bit by bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

STABLE = 1e-8  # keeps steps finite where a gradient has vanished (Kingma and Ba, section 2)


class Adam:
    """Adam (Kingma and Ba, "Adam: a method for stochastic optimization", 2015, algorithm 1).

    Args:
        parameters: Tensors that are moved; those without a gradient stay.
        rate: Learning rate.
        betas: How much of the running mean of gradients, and of their squares, is kept.

    Attributes:
        rate: Learning rate of the next step.
    """

    def __init__(
        self, parameters: Iterable[Tensor], rate: float, betas: tuple[float, float] = (0.9, 0.999)
    ):
        self.parameters = list(parameters)
        self.rate, self.betas = rate, betas
        self._counts = [0] * len(self.parameters)
        self._means = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self._squares = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move every parameter by its gradient."""
        first, second = self.betas
        for k, parameter in enumerate(self.parameters):
            if parameter.grad is None:
                continue
            self._counts[k] += 1
            mean, square, count = self._means[k], self._squares[k], self._counts[k]
            mean.lerp_(parameter.grad, 1.0 - first)
            square.mul_(second).addcmul_(parameter.grad, parameter.grad, value=1.0 - second)
            root = square.sqrt() / (1.0 - second**count) ** 0.5
            parameter.addcdiv_(mean, root.add_(STABLE), value=-self.rate / (1.0 - first**count))

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes, copied."""
        return {
            "counts": list(self._counts),
            "means": [mean.clone() for mean in self._means],
            "squares": [square.clone() for square in self._squares],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict``.

        Args:
            state: As ``state_dict`` gave it, of as many parameters.

        Raises:
            ValueError: another optimizer's state.
        """
        if set(state) != {"counts", "means", "squares"}:
            raise ValueError(
                f"the optimizer's state must hold counts, means and squares, got {sorted(state)}: "
                "a checkpoint of an earlier version; train anew, without --resume"
            )
        self._counts = list(state["counts"])
        for name in ("means", "squares"):
            for mine, kept in zip(getattr(self, f"_{name}"), state[name], strict=True):
                mine.copy_(kept)
