"""TorchRL collects transitions of an environment.

`python examples/learning/torchrl_collector.py` (extra `rl`, and `pip install torchrl`): a random
policy, 400 frames of CopterHover. Expected: the shape of the data and a mean reward of about 0.74.
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import gymnasium
import torch
from torchrl.envs import GymWrapper, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import RandomPolicy

try:
    from torchrl.collectors import Collector
except ImportError:  # before TorchRL 0.14
    from torchrl.collectors import SyncDataCollector as Collector

import diffsim.envs  # noqa: F401 - registers the environments


def main(frames: int = 400) -> dict[str, object]:
    """Collect; returns the data's shape and mean reward."""
    torch.manual_seed(0)
    inner = GymWrapper(gymnasium.make("diffsim/CopterHover-v0"))
    env = TransformedEnv(inner)
    env.append_transform(RewardSum())
    env.append_transform(StepCounter())
    env.set_seed(0)
    policy = RandomPolicy(env.action_spec)
    collector = Collector(env, policy, frames_per_batch=200, total_frames=frames)
    batches = list(collector)
    collector.shutdown()
    data = torch.cat(batches)
    return {"shape": tuple(data.shape), "reward": float(data["next", "reward"].mean())}


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name}: {value}")
