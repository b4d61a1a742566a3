"""Implicit against explicit time stepping: smoothness of the loss, time and memory (fig. 4-3)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks import soft_worker
from benchmarks.harness import Part
from benchmarks.processes import run_child
from benchmarks.soft_cantilever import options
from benchmarks.soft_scenes import LENGTH, cantilever, twisted, weighted_loss
from diffsim import soft
from diffsim.core.errors import DiffsimError

Array = NDArray[np.float64]
STABILITY = "explicit/stable step"
# The last one tells what the motion itself is like: its step is far below what stability asks for.
EXPLICIT, FINE = "semi_implicit_euler", "semi_implicit_euler, dt / 4"
COMPARED = ("implicit_euler", EXPLICIT)
INTEGRATORS = ("implicit_euler", "bdf2", "implicit_midpoint", EXPLICIT, FINE)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    cells: Sequence[int] = (12, 3, 3)  # cells along x, y, z
    duration: float = 0.2  # simulated time [s]
    dt: float = 1e-2  # step of the implicit integrators [s]
    directions: int = 16  # random directions around the initial positions
    samples: int = 21  # points along a direction, odd
    reach: float = 0.003  # largest change of a coordinate, of the beam's length [-]
    # tolerance of implicit steps: tight, so that what is seen is not the solver's noise
    rtol: float = 1e-6
    integrators: Sequence[str] = INTEGRATORS  # compared; explicit ones take their own step
    seconds: float = 3.0  # passes for timing are repeated for this long [s]


def parts(plan: Plan) -> list[Part]:
    """The stable step; then, per integrator, the loss around x0, and time and memory."""
    settings = asdict(plan)
    found = [Part(STABILITY, settings, lambda results, say: stable_step(plan, say))]
    for name in plan.integrators:
        found.append(
            Part(
                f"explicit/landscape, {name}",
                settings,
                lambda results, say, name=name: landscape(plan, name, results[STABILITY], say),
            )
        )
    for name in COMPARED:
        for checkpoints in (False, True):
            found.append(
                Part(
                    f"explicit/memory, {name}{', checkpoints' if checkpoints else ''}",
                    settings,
                    lambda results, say, name=name, checkpoints=checkpoints: cost(
                        plan, name, checkpoints, results[STABILITY]
                    ),
                )
            )
    return found


def directions(plan: Plan, body: soft.SoftBody, count: int) -> list[Tensor]:
    """Random shifts of the initial positions, (num_nodes, 3) each [m].

    As in the published code, every coordinate is uniform in +-reach times the beam's length; held
    nodes stay.
    """
    rng = np.random.default_rng(0)
    reach = plan.reach * LENGTH
    shifts = [torch.from_numpy(rng.uniform(-reach, reach, body.x_rest.shape)) for _ in range(count)]
    return [shift * ~body.fixed for shift in shifts]


def losses_and_gradients(body: soft.SoftBody, x: Tensor, num_steps: int) -> tuple[Array, Array]:
    """Loss and norm of its gradient to initial x and v, of every item of a batch of initial x."""
    x = x.requires_grad_()
    v = torch.zeros_like(x, requires_grad=True)
    loss = weighted_loss(soft.rollout(body, soft.State(x, v), num_steps).final)
    grads = torch.autograd.grad(loss.sum(), (x, v))
    size = torch.sqrt(sum(g.square().sum((1, 2)) for g in grads))
    return loss.detach().numpy(), size.numpy()


def energy_kept(body: soft.SoftBody, num_steps: int) -> float:
    """Mechanical energy above that of the rest shape after a rollout, over that before [-]."""
    physics = body.physics()
    mass = physics.mass[:, None]

    def energy(state: soft.State) -> float:
        kinetic = 0.5 * (mass * state.v.square()).sum()
        weight = -(mass * physics.gravity * state.x).sum()
        return float(body.elastic_energy(state.x) + kinetic + weight)

    x = twisted(body)
    start, rest = soft.State(x, torch.zeros_like(x)), energy(body.rest_state())
    with torch.no_grad():
        end = soft.rollout(body, start, num_steps).final
    return (energy(end) - rest) / (energy(start) - rest)


def stable_step(plan: Plan, say: Callable[[str], None]) -> dict[str, Any]:
    """Largest explicit step that is stable forward and backward at x0 and all around it.

    Around it: at both ends of some of the landscape's directions. Unstable: a loss or gradient
    norm is ten times what it is at a quarter of the step that linear theory asks for (an unstable
    mode grows by orders of magnitude within a few steps, so that ten is not critical).
    """
    frequency = largest_frequency(plan)
    linear = 2.0 / frequency
    safe = math.ceil(plan.duration / linear * 4)

    def measure(num_steps: int) -> tuple[Array, Array]:
        say(f"{num_steps} steps")
        body = cantilever("hex", plan.cells, dt=plan.duration / num_steps, integrator=EXPLICIT)
        shifts = directions(plan, body, max(1, plan.directions // 4))
        around = [torch.zeros_like(shifts[0]), *shifts, *(-shift for shift in shifts)]
        try:
            return losses_and_gradients(body, twisted(body) + torch.stack(around), num_steps)
        except DiffsimError:  # positions have become infinite
            return np.full(len(around), np.inf), np.full(len(around), np.inf)

    loss, size = measure(safe)

    def stable(num_steps: int) -> bool:
        found_loss, found_size = measure(num_steps)
        # Comparisons are false for what is not a number.
        return bool(
            np.all(np.abs(found_loss) <= 10 * np.abs(loss).max())
            and np.all(found_size <= 10 * size)
        )

    low, high = math.ceil(plan.duration / linear / 4), safe
    while high - low > max(1, high // 100):
        middle = (low + high) // 2
        low, high = (low, middle) if stable(middle) else (middle, high)
    return {
        "num_steps": high,
        "dt_s": plan.duration / high,
        "dt_linear_s": linear,
        "largest_angular_frequency_rad_s": frequency,
        "reference_num_steps": safe,
    }


def largest_frequency(plan: Plan, iterations: int = 200) -> float:
    """Largest angular frequency about the rest shape [rad/s], by the power method."""
    body = cantilever("hex", plan.cells)
    free, mass = ~body.fixed, body.physics().mass[:, None]
    x = body.x_rest.clone().requires_grad_()
    force = body.elastic_force(x)
    mode = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype) * free
    squared = 0.0
    for _ in range(iterations):
        (product,) = torch.autograd.grad(force, x, mode, retain_graph=True)
        mode = -product / mass * free
        squared = float(mode.norm())
        mode = mode / squared
    return math.sqrt(squared)


def landscape(
    plan: Plan, integrator: str, stability: dict[str, Any], say: Callable[[str], None]
) -> dict[str, Any]:
    """Loss and gradient norm along random directions, (directions, samples); one batch each."""
    num_steps = steps_of(plan, integrator, stability)
    name, _, _ = integrator.partition(",")
    body = cantilever("hex", plan.cells, dt=plan.duration / num_steps, integrator=name)
    body.solver = options("auto", plan.rtol)
    # The two of fig. 4-3 get all directions; the others are there for their smoothness alone.
    count = plan.directions if integrator in COMPARED else max(2, plan.directions // 4)
    alphas = torch.linspace(-1.0, 1.0, plan.samples, dtype=torch.float64)
    losses, sizes = [], []
    for k, direction in enumerate(directions(plan, body, count)):
        say(f"direction {k + 1}/{count}, {num_steps} steps")
        x = twisted(body) + alphas[:, None, None] * direction
        loss, size = losses_and_gradients(body, x, num_steps)
        losses.append(loss)
        sizes.append(size)
    return {
        "integrator": integrator,
        "dt_s": plan.duration / num_steps,
        "num_steps": num_steps,
        "alpha": (plan.reach * alphas).tolist(),
        "energy_kept": energy_kept(body, num_steps),
        "loss": np.array(losses),
        "grad_norm": np.array(sizes),
        "loss_smoothness": smoothness(np.array(losses)),
        "grad_norm_smoothness": smoothness(np.array(sizes)),
    }


def smoothness(values: Array) -> dict[str, float]:
    """How rough values (directions, samples) are, relative to the value in the middle [-].

    ``change_mean``, ``change_std``: of the relative change at the ends; ``roughness``: standard
    deviation of second differences (zero for straight lines); ``roughness_of_change``: the same
    over that of first differences, so that a steep but smooth slope counts as smooth.
    """
    relative = values / values[:, values.shape[1] // 2, None] - 1.0
    first, second = np.diff(relative, axis=1), np.diff(relative, n=2, axis=1)
    ends = relative[:, [0, -1]]
    return {
        "change_mean": float(ends.mean()),
        "change_std": float(ends.std()),
        "roughness": float(second.std()),
        "roughness_of_change": float(second.std() / first.std()),
    }


def steps_of(plan: Plan, integrator: str, stability: dict[str, Any]) -> int:
    """Steps of an integrator for the plan's duration."""
    if integrator in (EXPLICIT, FINE):
        return int(stability["num_steps"]) * (4 if integrator == FINE else 1)
    return round(plan.duration / plan.dt)


def cost(
    plan: Plan, integrator: str, checkpoints: bool, stability: dict[str, Any]
) -> dict[str, Any]:
    """Time and memory of one rollout with gradient, in a process of its own."""
    num_steps = steps_of(plan, integrator, stability)
    settings = {
        "cells": plan.cells,
        "integrator": integrator,
        "dt": plan.duration / num_steps,
        "num_steps": num_steps,
        "rtol": plan.rtol,
        "checkpoint_every": math.isqrt(num_steps - 1) + 1 if checkpoints else None,
        "seconds": plan.seconds,
    }
    return {**settings, **run_child(soft_worker.rollout_memory, settings, timeout=600.0)}
