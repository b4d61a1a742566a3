"""stable-baselines3 on the native vector environment, in ten lines.

`python examples/learning/ppo_in_ten_lines.py` (extra `rl`): PPO learns to hold a quadcopter in
place. A step in the air earns up to 1, an episode of 200 steps up to 200. Expected: from about 60
before (it crashes after two seconds) to above 110 after 60,000 steps, all of them in the air.
`rl/train_gradient.py --task CopterHover` does the same through the simulator's gradient.
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from diffsim.envs import Sb3VecEnv, make_vector


def main(steps: int = 60_000, num_envs: int = 32, seed: int = 0) -> dict[str, float]:
    """Train; returns mean returns of 16 episodes, before and after."""
    env = VecMonitor(Sb3VecEnv(make_vector("CopterHover", num_envs)))
    model = PPO("MlpPolicy", env, n_steps=128, batch_size=512, seed=seed, device="cpu")
    before, _ = evaluate_policy(model, env, n_eval_episodes=16)
    model.learn(steps)
    after, _ = evaluate_policy(model, env, n_eval_episodes=16)
    return {"before": float(before), "after": float(after)}


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--steps", type=int, default=60_000)
        parser.add_argument("--seed", type=int, default=0)
        args = parser.parse_args()
        for name, value in main(args.steps, seed=args.seed).items():
            print(f"mean return {name}: {value:.1f}")
