"""Many steps: trajectories with checkpointing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from diffsim.contact import Obstacle, check_clear
from diffsim.contact.obstacle import require_obstacles
from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.soft.inputs import LOADS, Loads, check_load, check_state, make_loads
from diffsim.soft.physics import Physics
from diffsim.soft.prepared import PreparedBody, prepare
from diffsim.soft.solid import Solid
from diffsim.soft.state import State, Trajectory
from diffsim.soft.step import advance

Obstacles = Sequence[Obstacle] | Obstacle | Callable[[int, State], Sequence[Obstacle]] | None
Signal = Tensor | Callable[[int, State], Tensor] | None


@checked
def rollout(
    body: Solid,
    state: State,
    num_steps: int,
    *,
    external_force: Signal = None,
    activation: Signal = None,
    pressure: Signal = None,
    dirichlet_target: Signal = None,
    obstacles: Obstacles = None,
    physics: Physics | None = None,
    checkpoint_every: int | None = None,
    keep: Callable[[State], Tensor] | None = None,
) -> Trajectory:
    """Take ``num_steps`` steps.

    Args:
        body: The body.
        state: Initial state, (..., num_nodes, 3).
        num_steps: Number of steps, >= 1.
        external_force: One tensor for all steps, or ``f(step, state)`` for closed loops and for
            signals in time [N].
        activation, pressure, dirichlet_target: Signals of the same kind as ``external_force``;
            shapes and units as in :func:`diffsim.soft.step`.
        obstacles: Obstacles at their poses at the start, which then move by their velocities; or
            ``f(step, state)`` that returns those of a step at the step's start.
        physics: Parameters from ``body.physics(...)``; None: the body's own.
        checkpoint_every: Store the graph of that many steps at a time and recompute the rest in
            the backward pass: memory of about num_steps / k + k states instead of all. Callables
            must then be deterministic.
        keep: Function of a state whose result is kept instead of x, for example marker positions.

    Returns:
        :class:`~diffsim.soft.Trajectory`; x (num_steps + 1, ...), the initial state first.
        Gradients: as in :func:`diffsim.soft.step`.
    """
    require_number("num_steps", num_steps, at_least=1)
    if checkpoint_every is not None:
        require_number("checkpoint_every", checkpoint_every, at_least=1)
    prepared = prepare(body, physics)
    state = check_state(prepared, state)
    signals = {
        "external_force": external_force,
        "activation": activation,
        "pressure": pressure,
        "dirichlet_target": dirichlet_target,
    }
    loads_at = LoadsInTime(prepared, state.x.shape, signals)
    obstacles_at = _obstacles_at(body, obstacles, state)

    def go_on(first: int, count: int, start: State) -> tuple[list[Tensor], list[Tensor], State]:
        xs, vs = [], []
        now = start
        for k in range(first, first + count):
            now = advance(now, loads_at(k, now), obstacles_at(k, now))
            xs.append(now.x if keep is None else keep(now))
            vs.append(now.v)
        return xs, vs, now

    xs, vs = [state.x if keep is None else keep(state)], [state.v]
    block = checkpoint_every or num_steps
    for first in range(0, num_steps, block):
        count = min(block, num_steps - first)
        if checkpoint_every is None:
            more_x, more_v, state = go_on(first, count, state)
        else:
            more_x, more_v, state = checkpoint(go_on, first, count, state, use_reentrant=False)
        xs += more_x
        vs += more_v
    return Trajectory(torch.stack(xs), torch.stack(vs), state)


class LoadsInTime:
    """What acts in each step of a rollout; what no step changes is checked once.

    Args:
        shape: Of the positions, (..., num_nodes, 3).
        signals: ``LOADS`` by name, as ``rollout`` takes them.
    """

    def __init__(
        self, prepared: PreparedBody, shape: tuple[int, ...], signals: Mapping[str, Signal]
    ):
        self._prepared, self._shape = prepared, shape
        self._moving: dict[str, Callable[[int, State], Tensor]] = {}
        self._parts: dict[str, Tensor] = {}
        for name in LOADS:
            signal = signals.get(name)
            if callable(signal) and not isinstance(signal, Tensor):
                self._moving[name] = signal
            else:
                self._parts[name] = check_load(prepared, shape, name, signal)

    def __call__(self, k: int, state: State) -> Loads:
        """The loads in step k from ``state``."""
        moved = {
            name: check_load(self._prepared, self._shape, name, signal(k, state))
            for name, signal in self._moving.items()
        }
        return make_loads(self._prepared, self._parts | moved)


def _obstacles_at(
    body: Solid, obstacles: Obstacles, start: State
) -> Callable[[int, State], Sequence[Obstacle] | None]:
    """Obstacles of step k; refuses a start in the middle of one."""
    if obstacles is None:
        return lambda k, state: None
    if callable(obstacles):
        first, signal = obstacles(0, start), obstacles
    else:
        first = require_obstacles(obstacles)

        def signal(k: int, state: State) -> Sequence[Obstacle]:
            return [obstacle.after(k * body.dt) for obstacle in first]

    if not torch.compiler.is_compiling():
        for x in start.x.detach().reshape(-1, *start.x.shape[-2:]):
            check_clear(first, body.mesh, x)
    return signal
