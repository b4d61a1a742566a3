"""stable-baselines3 on the native vector environment, in ten lines.

`python examples/learning/ppo_in_ten_lines.py` (about two minutes on one core; extra `rl`). PPO learns to
hold a quadcopter in place. Expected: the mean return of an episode rises from about -200 (it falls
and is ended) towards -50; training longer goes on rising. `rl/train_gradient.py --task CopterHover`
does the same through the simulator's gradient.
"""

from __future__ import annotations

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from diffsim.envs import Sb3VecEnv, make_vector


def main(steps: int = 200_000, num_envs: int = 32, seed: int = 0) -> dict[str, float]:
    """Train; returns mean returns of 16 episodes, before and after."""
    env = VecMonitor(Sb3VecEnv(make_vector("CopterHover", num_envs)))
    model = PPO("MlpPolicy", env, n_steps=128, batch_size=512, seed=seed, device="cpu")
    before, _ = evaluate_policy(model, env, n_eval_episodes=16)
    model.learn(steps)
    after, _ = evaluate_policy(model, env, n_eval_episodes=16)
    return {"before": float(before), "after": float(after)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for name, value in main(args.steps, seed=args.seed).items():
        print(f"mean return {name}: {value:.1f}")
