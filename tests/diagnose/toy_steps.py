"""Steps of the toy oscillator: in C++ where a compiler is at hand, in NumPy otherwise.

Diagnoses simulate it thousands of times, and a step in NumPy spends its time in the interpreter:
4.4 ms a record, 0.06 ms in C++.
"""

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SOURCE = Path(__file__).with_suffix(".cpp")
FLAGS = ("-O2", "-shared", "-fPIC", "-ffp-contract=off")


@lru_cache(maxsize=1)
def compiled() -> ctypes.CDLL | None:
    """The library beside the byte code, made where it is missing or its source is another."""
    compiler = next(filter(None, map(shutil.which, ("g++", "clang++", "c++"))), None)
    if compiler is None or sys.platform == "win32":
        return None
    key = "\0".join((SOURCE.read_text(), *FLAGS, compiler, platform.machine()))
    name = f"{SOURCE.stem}.{hashlib.sha256(key.encode()).hexdigest()[:16]}.so"
    library = SOURCE.parent / "__pycache__" / name
    if not library.exists():
        library.parent.mkdir(exist_ok=True)
        part = library.with_suffix(f".{os.getpid()}")  # workers may build it at once
        subprocess.run([compiler, *FLAGS, str(SOURCE), "-o", str(part)], check=True)
        part.replace(library)
    return ctypes.CDLL(str(library))


def rk4(terms: Array, push: Array, h: float) -> tuple[Array, Array]:
    """Positions and velocities (points, samples) from rest, with a push at each half step.

    Args:
        terms: Stiffness, damping, hardening, drag and friction of each point, (points, 5).
        push: (points, 2 samples - 1).
        h: Step [s].
    """
    library = compiled()
    if library is None:
        return rk4_in_numpy(terms, push, h)
    return _called(library.rk4_steps, terms, push, (ctypes.c_double(h),))


def implicit_euler(terms: Array, push: Array, h: float, substeps: int) -> tuple[Array, Array]:
    """The same of a linear oscillator, in steps of ``h`` and ``substeps`` of them for each sample.

    Args:
        terms: Angular frequency and damping ratio of each point, (points, 2).
        push: As above.
        h: Step [s].
        substeps: Number of steps for each sample.
    """
    library = compiled()
    if library is None:
        return implicit_euler_in_numpy(terms, push, h, substeps)
    more = (ctypes.c_long(substeps), ctypes.c_double(h))
    return _called(library.implicit_steps, terms, push, more)


def _called(steps, terms, push, more):
    points, stages = push.shape
    samples = stages // 2 + 1
    terms, push = np.ascontiguousarray(terms), np.ascontiguousarray(push)
    xs, vs = np.empty((2, points, samples))
    arrays = [ctypes.c_void_p(a.ctypes.data) for a in (terms, push, xs, vs)]
    steps(ctypes.c_long(points), ctypes.c_long(samples - 1), *more, *arrays)
    return xs, vs


def rk4_in_numpy(terms: Array, push: Array, h: float) -> tuple[Array, Array]:
    """What the C++ has, for all points at once."""
    stiffness, damping, hard, drag, rub = terms.T

    def acceleration(x, v, f):
        out = stiffness * (f - x) - damping * v
        out = out - stiffness * hard * x * x * x
        out = out - drag * np.abs(v) * v
        return out - rub * np.tanh(v / 0.02)

    x = v = np.zeros(len(push))
    xs, vs = [x], [v]
    for k in range(0, push.shape[1] - 2, 2):
        a0 = acceleration(x, v, push[:, k])
        v1 = v + 0.5 * h * a0
        a1 = acceleration(x + 0.5 * h * v, v1, push[:, k + 1])
        v2 = v + 0.5 * h * a1
        a2 = acceleration(x + 0.5 * h * v1, v2, push[:, k + 1])
        v3 = v + h * a2
        a3 = acceleration(x + h * v2, v3, push[:, k + 2])
        x = x + h / 6 * (v + 2 * v1 + 2 * v2 + v3)
        v = v + h / 6 * (a0 + 2 * a1 + 2 * a2 + a3)
        xs.append(x)
        vs.append(v)
    return np.stack(xs, 1), np.stack(vs, 1)


def implicit_euler_in_numpy(
    terms: Array, push: Array, h: float, substeps: int
) -> tuple[Array, Array]:
    """What the C++ has, for all points at once."""
    w, zeta = terms.T
    x = v = np.zeros(len(push))
    xs, vs = [x], [v]
    for k in range(0, push.shape[1] - 2, 2):
        for s in range(1, substeps + 1):
            share = s / substeps
            f = (1 - share) * push[:, k] + share * push[:, k + 2]
            v = (v + h * w * w * (f - x)) / (1 + 2 * zeta * w * h + (w * h) ** 2)
            x = x + h * v
        xs.append(x)
        vs.append(v)
    return np.stack(xs, 1), np.stack(vs, 1)
