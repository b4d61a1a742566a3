"""States and trajectories of a soft body."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from diffsim.core.module import loadable


@loadable
class State(NamedTuple):
    """Positions and velocities; BDF2 also remembers the step before.

    Attributes:
        x: Positions, (..., num_nodes, 3) [m].
        v: Velocities, same shape [m/s].
        x_prev: Positions one step earlier, or None (then BDF2 starts with implicit Euler).
        v_prev: Velocities one step earlier, or None.
        contact_force: Forces of obstacles on the nodes in the step that led here, shape of x [N],
            or None where there were no obstacles. The next step starts its search from them.
    """

    x: Tensor
    v: Tensor
    x_prev: Tensor | None = None
    v_prev: Tensor | None = None
    contact_force: Tensor | None = None

    def detach(self) -> State:
        """The same state without its history of gradients."""
        cut = {k: v.detach() for k, v in self._asdict().items() if v is not None}
        return State(**cut)


def require_state(state: State) -> State:
    """Refuse what is no :class:`State`."""
    if not isinstance(state, State):
        raise TypeError(
            f"state must be a State, got {type(state).__name__}; "
            "use State(x, v) or body.rest_state()"
        )
    return state


@loadable
class Trajectory(NamedTuple):
    """States of a rollout, the initial one first.

    Attributes:
        x: Positions, (num_steps + 1, ..., num_nodes, 3) [m].
        v: Velocities, same shape [m/s].
        final: The last state, from which a rollout can go on.
    """

    x: Tensor
    v: Tensor
    final: State
