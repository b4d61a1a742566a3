"""What processes that train together do; importable by workers."""

from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from diffsim.learn.gradient import GradientLearner, GradientOptions
from diffsim.learn.run import train
from diffsim.learn.setup import Setup

BATCH = 5  # shared unevenly


def setup(**changes: Any) -> Setup:
    options: dict[str, Any] = {"evaluation_episodes": 2, "warm_up": 5}
    return Setup("CopterHover", {"seconds": 0.2}, **{**options, **changes})


def learner(**changes: Any) -> GradientLearner:
    # no clipping: the gradient is left as it is
    return GradientLearner(setup(), GradientOptions(**{"batch": BATCH, "clip": 1e9, **changes}))


def updated(made: GradientLearner) -> dict[str, Any]:
    """Gradient of the first update, then weights, moments and reward after the third."""
    first = made.update(0.0)
    gradients = [p.grad.flatten() for p in made.net.parameters() if p.grad is not None]
    gradient = torch.cat([torch.zeros(0, dtype=torch.float64), *gradients])
    for progress in (0.3, 0.6):
        last = made.update(progress)
    return {
        "gradient": gradient.clone(),
        "first": first.scalars["train/reward"],
        "reward": last.scalars["train/reward"],
        "bad": last.scalars["train/bad_updates"],
        **{f"net.{k}": v.clone() for k, v in made.net.state_dict().items()},
    }


def together(rank: int, count: int, meeting: str) -> dict[str, Any]:
    """``updated`` as one of several processes."""
    with _met(rank, count, meeting):
        return updated(learner())


def with_a_bad_part(rank: int, count: int, meeting: str) -> dict[str, Any]:
    """The same; the second process's first episodes break down."""
    with _met(rank, count, meeting):
        made = learner()
        if rank == 1:
            plain = made._differentiate

            def broken(*args: Any) -> Any:
                made._differentiate = plain  # type: ignore[method-assign]
                raise ArithmeticError("left the finite numbers")

            made._differentiate = broken  # type: ignore[method-assign]
        return updated(made)


def trained(rank: int, count: int, meeting: str, folder: str) -> list[Any]:
    """Ratings of a whole training in a folder that all share."""
    with _met(rank, count, meeting):
        run = train(setup(steps=200, evaluate_every=100), learner(), Path(folder), show=False)
        return [row["reward"] for row in run.rows]


class _met:
    def __init__(self, rank: int, count: int, meeting: str):
        self.where = {"init_method": f"file://{meeting}", "rank": rank, "world_size": count}

    def __enter__(self) -> None:
        dist.init_process_group("gloo", **self.where)

    def __exit__(self, *_: object) -> None:
        dist.destroy_process_group()
