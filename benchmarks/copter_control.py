"""Gradient accuracy and time of the hover and LQR layers of multicopters, against scipy.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.copter_control --seconds 1 --output runs/control.json

Random designs of four to eight tilted rotors. Gradients are held against central differences of
fourth order along one random direction. Times are medians of process CPU time; torch runs on one
thread, and scipy's linear algebra too with the variable set.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.linalg
import scipy.optimize
import torch
from torch import Tensor

from benchmarks.harness import repeat_for, spread
from diffsim.copter import Multicopter, hover, hover_thrusts, linearize, lqr, lqr_stats, lyapunov
from diffsim.core import interruptible
from diffsim.core.compiled import INSTRUCTION_SET
from diffsim.core.files import write_json_atomic

Layer = Callable[..., tuple[Tensor, ...]]


def design(num_rotors: int, seed: int = 1) -> Multicopter:
    """Arms of 0.2 to 0.3 m around the circle, axes tilted by up to 0.07 rad."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(num_rotors) / num_rotors
    arm = rng.uniform(0.2, 0.3, num_rotors)
    tilt = rng.uniform(-0.05, 0.05, (num_rotors, 2))
    directions = np.concatenate([tilt, -np.ones((num_rotors, 1))], 1)
    values = {
        "mass": 0.35 * num_rotors,
        "inertia": np.diag([0.02, 0.025, 0.04]),
        "positions": np.stack([arm * np.cos(angle), arm * np.sin(angle), 0.0 * arm], 1),
        "directions": directions / np.linalg.norm(directions, axis=1, keepdims=True),
        "spins": np.where(np.arange(num_rotors) % 2 == 0, 1.0, -1.0),
        "torque_ratios": np.full(num_rotors, 0.02),
        "max_thrusts": np.full(num_rotors, 12.0),
        "radii": np.full(num_rotors, 0.1),
    }
    return Multicopter(**{k: torch.as_tensor(v, dtype=torch.float64) for k, v in values.items()})


def hover_arguments(copter: Multicopter) -> list[Tensor]:
    return [copter.force_matrix, copter.torque_matrix, copter.weight, copter.max_thrusts]


def thrusts(*args: Tensor) -> tuple[Tensor, ...]:
    return (hover_thrusts(*args).thrusts,)


def lqr_arguments(copter: Multicopter) -> list[Tensor]:
    result = hover(copter, on_infeasible="raise")
    weights = [10.0 * torch.eye(12, dtype=torch.float64)]
    weights.append(torch.eye(copter.num_rotors, dtype=torch.float64))
    return [*linearize(copter, result.thrusts, result.attitude), *weights]


def gradient_error(layer: Layer, args: list[Tensor], step: float) -> float:
    """Relative difference of a directional derivative from fourth-order differences."""
    rng = np.random.default_rng(0)
    moves = [torch.from_numpy(rng.standard_normal(t.shape)) * t.abs().max() for t in args]
    moves = [m + m.mT if _symmetric(a) else m for a, m in zip(args, moves, strict=True)]
    outputs = layer(*args)
    cotangents = [torch.from_numpy(rng.standard_normal(t.shape)) for t in outputs]

    def loss(h: Tensor | float) -> Tensor:
        moved = [a + h * m for a, m in zip(args, moves, strict=True)]
        products = [(c * o).sum() for c, o in zip(cotangents, layer(*moved), strict=True)]
        return torch.stack(products).sum()

    h = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(h), h)
    near = loss(step) - loss(-step)
    far = loss(2.0 * step) - loss(-2.0 * step)
    numeric = float(8.0 * near - far) / (12.0 * step)
    return abs(float(slope) - numeric) / abs(numeric)


def _symmetric(t: Tensor) -> bool:
    return t.ndim == 2 and torch.equal(t, t.mT)


def milliseconds(call: Callable[[], object], seconds: float) -> dict[str, float]:
    """Median and quartiles of CPU time per call [ms]."""
    times = repeat_for(call, seconds=seconds, at_most=5000)
    return {k: 1e3 * v if k != "count" else v for k, v in spread([t.cpu for t in times]).items()}


def with_backward(layer: Layer, args: list[Tensor]) -> Callable[[], object]:
    leaves = [a.clone().requires_grad_() for a in args]
    return lambda: torch.autograd.grad(
        torch.cat([o.flatten() for o in layer(*leaves)]).sum(), leaves
    )


def scipy_hover(copter: Multicopter) -> Callable[[], object]:
    """Least effort in thrusts, roll and pitch by SLSQP, what one would write without the layer."""
    F, T, weight = (t.numpy() for t in hover_arguments(copter)[:3])
    n = copter.num_rotors

    def balance(x: np.ndarray) -> np.ndarray:
        (sr, sp), (cr, cp) = np.sin(x[n:]), np.cos(x[n:])
        down = np.array([-sp, cp * sr, cp * cr])
        return np.concatenate([F @ x[:n] / weight + down, T @ x[:n] / weight])

    start = np.append(np.full(n, weight / n), [0.0, 0.0])
    limits = [(0.0, float(m)) for m in copter.max_thrusts] + [(-1.0, 1.0)] * 2
    return lambda: scipy.optimize.minimize(
        lambda x: 0.5 * x[:n] @ x[:n] / weight,
        start,
        jac=lambda x: np.append(x[:n] / weight, [0.0, 0.0]),
        bounds=limits,
        constraints={"type": "eq", "fun": balance},
        method="SLSQP",
    )


def measure(num_rotors: int, seconds: float) -> dict[str, object]:
    """Everything for one design."""
    copter = design(num_rotors)
    problem, regulator = hover_arguments(copter), lqr_arguments(copter)
    arrays = [t.numpy() for t in regulator]
    K, P = lqr(*regulator)
    closed = regulator[0] - regulator[1] @ K
    P_scipy = scipy.linalg.solve_continuous_are(*arrays)
    many = [t.expand(1000, *t.shape).contiguous() for t in problem]
    many_lqr = [t.expand(100, *t.shape).contiguous() for t in regulator]
    stats = lqr_stats(*regulator)
    calls: dict[str, Callable[[], object]] = {
        "hover": lambda: thrusts(*problem),
        "hover + backward": with_backward(thrusts, problem),
        "hover, batch of 1000": lambda: thrusts(*many),
        "hover, batch of 1000 + backward": with_backward(thrusts, many),
        "hover, scipy SLSQP": scipy_hover(copter),
        "lqr": lambda: lqr(*regulator),
        "lqr + backward": with_backward(lqr, regulator),
        "lqr, batch of 100": lambda: lqr(*many_lqr),
        "lqr, batch of 100 + backward": with_backward(lqr, many_lqr),
        "lqr, scipy solve_continuous_are": lambda: scipy.linalg.solve_continuous_are(*arrays),
        "lyapunov": lambda: lyapunov(closed, regulator[2]),
        "lyapunov, scipy": lambda: scipy.linalg.solve_continuous_lyapunov(
            closed.numpy(), -arrays[2]
        ),
    }
    return {
        "num_rotors": num_rotors,
        "hover_gradient_error": gradient_error(thrusts, problem, 1e-4),
        "lqr_gradient_error": gradient_error(lqr, regulator, 1e-5),
        "lqr_doublings": int(stats.num_iters),
        "lqr_residual": float(stats.residual),
        "lqr_difference_from_scipy": float(
            np.abs(P.numpy() - P_scipy).max() / np.abs(P_scipy).max()
        ),
        "milliseconds": {name: milliseconds(call, seconds) for name, call in calls.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0, help="per row")
    parser.add_argument("--output", type=Path, help="JSON file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{INSTRUCTION_SET}, one thread, CPU time")
    results = []
    for num_rotors in (4, 6, 8):
        result = measure(num_rotors, args.seconds)
        results.append(result)
        times = result.pop("milliseconds")
        assert isinstance(times, dict)
        print(", ".join(f"{k} {v:.3g}" for k, v in result.items()))
        for name, row in times.items():
            print(f"  {name:34s} {row['median']:9.4f} ms ({row['q1']:.4f} to {row['q3']:.4f})")
        result["milliseconds"] = times
    if args.output:
        write_json_atomic(args.output, results)


if __name__ == "__main__":
    with interruptible():
        main()
