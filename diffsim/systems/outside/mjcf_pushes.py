"""Forces at joints of a MuJoCo model that it does not have itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.systems.outside.forces import PlaceForces
from diffsim.systems.outside.mjcf_numbers import Numbers, several_axes


@dataclass(frozen=True, eq=False)
class Pushes:
    """Forces at the joints of a model."""

    plain: Any
    numbers: Numbers
    stages: int  # of a step of its integrator

    def is_known(self, force: PlaceForces) -> bool:
        """Whether forces over time alone are all there is, and an integrator that asks for them
        once a step: MuJoCo's own loop then holds them."""
        return force.is_over_time and self.stages == 1

    def _axis_of(self, place: str) -> tuple[int, int]:
        """Index of the position and of the velocity of a joint that turns or slides about one axis.

        Raises:
            ValueError: there is no such joint, or it has several axes.
        """
        joint = self.numbers.find("joint", place, "hooks.force")
        if (count := self.numbers.num_axes(joint)) > 1:
            raise ValueError(several_axes(place, count))
        return int(self.plain.jnt_qposadr[joint]), int(self.plain.jnt_dofadr[joint])

    def over(self, force: PlaceForces, times: Array) -> Array | None:
        """Forces of each degree of freedom over steps, (num_steps, nv); None: not known before."""
        if not self.is_known(force):
            return None
        out = np.zeros((len(times), self.plain.nv))
        for place, values in force.over(times).items():
            out[:, self._axis_of(force.places[place])[1]] += values
        return out

    def at_stages(self, force: PlaceForces) -> Callable[[Any, Any], None]:
        """What MuJoCo calls for passive forces: the forces at the joints that are the places."""
        acting = [(*self._axis_of(force.places[i]), at) for i, at in force.acting]

        def push(model: Any, data: Any) -> None:  # thousands of times a run: plain numbers alone
            time, positions, rates, passive = data.time, data.qpos, data.qvel, data.qfrc_passive
            for place, rate, at in acting:
                passive[rate] += at(time, positions.item(place), rates.item(rate))

        return push
