"""A PPO loop written out, as CleanRL writes them, on the native batch and gymnasium's wrappers.

`python examples/learning/ppo_on_the_batch.py` (extra `rl`): 32 quadcopters learn to hold their
place. Expected: a return of an episode of about 30 in the beginning (they crash) and above 110
after 60,000 steps, in some ten CPU seconds.

`autoreset_mode="NextStep"` is what gymnasium's `NormalizeObservation` asks for. The step after the
end of an episode only starts the next one, so that its transition is left out of the loss.
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import vector as wrappers
from torch import Tensor, nn

import diffsim.envs  # noqa: F401 - registers the environments

DISCOUNT, TRACE, CLIP = 0.99, 0.95, 0.2


class Agent(nn.Module):
    """Mean and spread of the commands, and the value."""

    def __init__(self, num_observations: int, num_actions: int):
        super().__init__()
        self.mean = _network(num_observations, num_actions, 0.01)
        self.value = _network(num_observations, 1, 1.0)
        self.log_spread = nn.Parameter(torch.full((num_actions,), -0.7))

    def policy(self, seen: Tensor) -> torch.distributions.Independent:
        """Distribution of the commands."""
        normal = torch.distributions.Normal(self.mean(seen), self.log_spread.exp())
        return torch.distributions.Independent(normal, 1)


def _network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()]
    last = nn.Linear(64, outputs)
    nn.init.orthogonal_(last.weight, gain)
    return nn.Sequential(*layers, last)


def make_envs(num_envs: int) -> gymnasium.vector.VectorEnv:
    """The native batch under gymnasium's own wrappers."""
    envs = gymnasium.make_vec(
        "diffsim/CopterHover-v0", num_envs=num_envs, autoreset_mode="NextStep"
    )
    envs = wrappers.RecordEpisodeStatistics(envs)
    envs = wrappers.NormalizeObservation(envs)
    return wrappers.ClipAction(envs)


def main(
    steps: int = 60_000, num_envs: int = 32, rollout: int = 128, seed: int = 0
) -> dict[str, float]:
    """Train; returns mean returns of the first and of the last fifth of the episodes."""
    torch.manual_seed(seed)
    envs = make_envs(num_envs)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    adam = torch.optim.Adam(agent.parameters(), lr=1e-3)
    seen, _ = envs.reset(seed=seed)
    over, returns = np.zeros(num_envs, dtype=bool), []
    for _ in range(steps // (num_envs * rollout)):
        rows: list[tuple[Tensor, ...]] = []
        for _ in range(rollout):
            now = torch.as_tensor(seen, dtype=torch.float32)
            with torch.no_grad():
                policy = agent.policy(now)
                command = policy.sample()
                value = agent.value(now)[:, 0]
            seen, reward, terminated, truncated, info = envs.step(command.numpy())
            earned = (torch.as_tensor(x, dtype=torch.float32) for x in (reward, terminated, over))
            rows.append((now, command, policy.log_prob(command), value, *earned))
            over = terminated | truncated
            returns += info["episode"]["r"][over].tolist() if over.any() else []
        with torch.no_grad():
            last = agent.value(torch.as_tensor(seen, dtype=torch.float32))[:, 0]
        learn(agent, adam, rows, last)
    envs.close()
    part = max(1, len(returns) // 5)
    return {"first": float(np.mean(returns[:part])), "last": float(np.mean(returns[-part:]))}


def learn(
    agent: Agent, adam: torch.optim.Adam, rows: list[tuple[Tensor, ...]], last: Tensor
) -> None:
    """Ten passes over a rollout."""
    seen, commands, log_probs, values, rewards, terminated, skipped = (
        torch.stack(column) for column in zip(*rows, strict=True)
    )
    # of a step that ends an episode, the value of what comes next is that of its last observation,
    # which NextStep returns; the step after it has no transition
    following = torch.cat([values[1:], last[None]])
    errors = rewards + DISCOUNT * (1.0 - terminated) * following - values
    goes_on = 1.0 - torch.cat([skipped[1:], torch.zeros_like(skipped[:1])])
    gains, gain = torch.zeros_like(values), torch.zeros_like(last)
    for k in reversed(range(len(rows))):
        gain = errors[k] + DISCOUNT * TRACE * goes_on[k] * gain
        gains[k] = gain
    used = skipped.flatten() == 0.0
    data = [x.flatten(0, 1)[used] for x in (seen, commands, log_probs, gains, gains + values)]
    for _ in range(10):
        for part in torch.randperm(len(data[0])).split(512):
            x, command, before, advantage, goal = (column[part] for column in data)
            policy = agent.policy(x)
            ratio = (policy.log_prob(command) - before).exp()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * advantage
            error = (agent.value(x)[:, 0] - goal).square().mean()
            adam.zero_grad()
            (0.5 * error - torch.minimum(ratio * advantage, clipped).mean()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            adam.step()


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--steps", type=int, default=60_000)
        parser.add_argument("--seed", type=int, default=0)
        args = parser.parse_args()
        for name, value in main(args.steps, seed=args.seed).items():
            print(f"mean return, {name} fifth of the episodes: {value:.1f}")
