"""The native vector environment for stable-baselines3, which does not take gymnasium's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from diffsim.core.arrays import Mask
from diffsim.core.checked import checked
from diffsim.envs.vector_env import TaskVectorEnv


class Sb3VecEnv(VecEnv):
    """Adapter: ``PPO("MlpPolicy", Sb3VecEnv(TaskVectorEnv(task, 16)))``.

    A truncated episode is marked by ``TimeLimit.truncated`` and keeps its last observation as
    ``terminal_observation``, from which stable-baselines3 bootstraps the value.
    """

    @checked
    def __init__(self, env: TaskVectorEnv):
        if env.autoreset_mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                "stable-baselines3 restarts within the step: the environment's autoreset_mode "
                f"must be SAME_STEP, got {env.autoreset_mode.name}"
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._seed: int | None = None
        self._actions: NDArray[np.float32] | None = None

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes, from the seed given to ``seed`` if it is new."""
        observations, _ = self.env.reset(seed=self._seed)
        self._seed = None
        return observations

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed of the next reset."""
        self._seed = seed
        return [seed] * self.num_envs

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], Mask, list[dict[str, Any]]]:
        """Take the step."""
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(done):
            infos[k] = {
                "terminal_observation": info["final_obs"][k],
                "TimeLimit.truncated": bool(truncated[k]),
            }
        return observations, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the environment's window, if it has one."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of the vector environment, once per member."""
        return [getattr(self.env, attr_name)] * len(self._list_indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Members share everything: an attribute is set for all of them."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment, once for all."""
        result = getattr(self.env, method_name)(*args, **kwargs)
        return [result] * len(self._list_indices(indices))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Members are not wrapped."""
        return [False] * len(self._list_indices(indices))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Pictures of all members."""
        return self.env.render() or [None] * self.num_envs

    def _list_indices(self, indices: int | Iterable[int] | None) -> list[int]:
        return list(self._get_indices(indices))
