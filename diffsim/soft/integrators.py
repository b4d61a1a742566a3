"""Time integrators as one implicit problem each.

Every implicit integrator here is x = argmin 1/2 c |x - y|_M^2 + E(x) - f.x with a velocity that is
affine in x, v = kappa (x - x_velocity); only c, y, kappa, x_velocity and what follows differ.
A mode of angular frequency w is damped numerically by about w h / 2 (implicit Euler), by
O((w h)^3) (BDF2), and not at all (implicit midpoint).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.soft.state import State

IMPLICIT = ("implicit_euler", "bdf2", "implicit_midpoint")
EXPLICIT = ("semi_implicit_euler",)
INTEGRATORS = IMPLICIT + EXPLICIT
# Non-penetration holds at the end of the step, so that must be the unknown; see soft/step.py.
WITH_CONTACT = ("implicit_euler", "bdf2")


class Rates(NamedTuple):
    """What an integrator's problems have of the time step."""

    c: float  # inertia per mass [1/s^2]
    kappa: float  # velocity per displacement [1/s]


VELOCITY = Rates(c=0.0, kappa=1.0)  # of explicit steps: displacements stand for velocities


@dataclass(frozen=True)
class ImplicitStage:
    """The implicit problem of one step."""

    rates: Rates  # inertia per mass, and velocity per displacement
    y: Tensor  # inertial position, (..., num_nodes, 3) [m]
    # position that velocity is measured from, (..., num_nodes, 3) [m]. The frame of
    # stiffness-proportional damping is y: it predicts the unknown to second order, so that damping
    # keeps the integrator's order.
    x_velocity: Tensor
    midpoint: bool = False  # the unknown is the position in the middle of the step


def rates_of(integrator: str, dt: float) -> tuple[Rates, ...]:
    """The rates of all problems that an integrator may pose."""
    if integrator in EXPLICIT:
        return (VELOCITY,)
    if integrator == "bdf2":  # it starts with implicit Euler, and takes it in contact
        return _euler(dt), _bdf2(dt)
    return (_euler(_euler_step(integrator, dt)),)


def _bdf2(dt: float) -> Rates:
    return Rates(c=2.25 / dt**2, kappa=1.5 / dt)


def _euler(h: float) -> Rates:
    return Rates(c=1.0 / h**2, kappa=1.0 / h)


def _euler_step(integrator: str, dt: float) -> float:
    # Implicit midpoint is implicit Euler over half a step, extrapolated.
    return dt / 2.0 if integrator == "implicit_midpoint" else dt


def make_stage(integrator: str, dt: float, state: State) -> ImplicitStage:
    """The problem of one step from ``state``; external and internal forces enter apart from y."""
    x, v = state.x, state.v
    if integrator == "bdf2" and state.x_prev is not None and state.v_prev is not None:
        # Curtiss and Hirschfelder 1952: x1 = (4 x - x_prev)/3 + 2h/3 v1, and the same for v1.
        x_velocity = (4.0 * x - state.x_prev) / 3.0
        y = x_velocity + (2.0 * dt / 9.0) * (4.0 * v - state.v_prev)
        return ImplicitStage(rates=_bdf2(dt), y=y, x_velocity=x_velocity)
    h = _euler_step(integrator, dt)
    midpoint = integrator == "implicit_midpoint"
    return ImplicitStage(rates=_euler(h), y=x + h * v, x_velocity=x, midpoint=midpoint)


def finish_stage(
    integrator: str, stage: ImplicitStage, state: State, solution: Tensor, fixed: Tensor
) -> State:
    """The state after a step, from the solution of its problem; fixed (num_nodes, 3) bool."""
    velocity = stage.rates.kappa * (solution - stage.x_velocity)
    if stage.midpoint:
        # Extrapolated, the velocity of a node with prescribed motion would alternate.
        return State(
            2.0 * solution - state.x,
            torch.where(fixed, velocity, 2.0 * velocity - state.v),
        )
    if integrator == "bdf2":
        return State(solution, velocity, state.x, state.v)
    return State(solution, velocity)
