"""The beam that every package is asked for, without any of them: nodes, tetrahedra, material, load and steps.

A clamped box of 0.3 x 0.1 x 0.1 m of one soft material sags under its weight. Asked is the mean fall of its free end, and
that fall's derivative by the logarithm of Young's modulus, beside central differences of the package's own answer.
"""

import json
import time
from collections.abc import Callable
from itertools import product

import numpy as np

CELLS = (6, 2, 2)
SIDE = 0.05  # m
YOUNGS_MODULUS, POISSONS_RATIO, DENSITY, GRAVITY = (
    1e5,
    0.3,
    1000.0,
    9.8,
)  # Pa, -, kg/m^3, m/s^2 along -y
STEP, STEPS = 0.01, 10  # s
DIFFERENCE = 1e-3  # of log E, to either side

# A cell in six tetrahedra around its diagonal from corner 0 to corner 7; corner x + 2 y + 4 z.
_OF_CELL = ((0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7))


def nodes() -> np.ndarray:
    """Nodes at rest (n_nodes, 3), in m."""
    axes = [np.arange(count + 1) * SIDE for count in CELLS]
    return np.array(list(product(*axes)))


def tetrahedra() -> np.ndarray:
    """Nodes of each tetrahedron (n_elements, 4), of positive volume."""
    number = np.arange(np.prod(np.add(CELLS, 1))).reshape(np.add(CELLS, 1))
    cells = product(*(range(count) for count in CELLS))
    corners = [
        [number[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)] for c in range(8)] for i, j, k in cells
    ]
    elements = np.array([[cell[c] for c in tet] for cell in corners for tet in _OF_CELL])
    x = nodes()[elements]
    inverted = np.linalg.det(x[:, 1:] - x[:, :1]) < 0
    elements[inverted] = elements[inverted][:, [0, 2, 1, 3]]
    return elements


def masses() -> np.ndarray:
    """A quarter of each tetrahedron's mass at each of its nodes (n_nodes,), in kg."""
    x, elements = nodes(), tetrahedra()
    volumes = np.linalg.det(x[elements][:, 1:] - x[elements][:, :1]) / 6
    mass = np.zeros(len(x))
    np.add.at(mass, elements, DENSITY * volumes[:, None] / 4)
    return mass


def clamped() -> np.ndarray:
    """Numbers of the nodes that are held."""
    return np.flatnonzero(nodes()[:, 0] == 0)


def free_end() -> np.ndarray:
    """Numbers of the nodes whose mean fall is asked."""
    return np.flatnonzero(np.isclose(nodes()[:, 0], CELLS[0] * SIDE))


def answer(version: str, fall: Callable[[float], tuple[float, float | None]]) -> None:
    """Print a package's answer as one line of JSON.

    Args:
        version: of the package
        fall: function of Young's modulus [Pa]: the fall [m] and its derivative by log E [m] (None: it offers none)
    """
    start = time.process_time()
    value, derivative = fall(YOUNGS_MODULUS)
    seconds = time.process_time() - start
    higher, lower = (fall(YOUNGS_MODULUS * np.exp(sign * DIFFERENCE))[0] for sign in (1, -1))
    print(
        json.dumps(
            {
                "version": version,
                "fall_mm": 1e3 * value,
                "derivative_mm": None if derivative is None else 1e3 * derivative,
                "difference_mm": 1e3 * (higher - lower) / (2 * DIFFERENCE),
                "cpu_s": seconds,
            }
        )
    )
