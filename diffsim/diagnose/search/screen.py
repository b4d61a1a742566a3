"""Screen candidates by their score at the null fit: what could matter, how large, what mimics what.

With r, J = dWS/dtheta and G = dWS/dphi at the null fit, prior N(0, 1) of theta:

    G~ = G - J (J'J + 1)^-1 J'G      what base parameters cannot absorb
    I = G'G~,  z = s / sqrt(I),  size = s / I,  smallest visible size = 6 / sqrt(I)
    confounding = cosine between G~_c and G~_d

A screen only: the refit decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.identify.problem import Problem

Array = NDArray[np.float64]
VISIBLE = 6.0


@dataclass(frozen=True, eq=False)
class Screen:
    """Scores of all components, in the order of ``names``.

    Attributes:
        names: Components of the effects, "wind.x" for vectors.
        z: Score of each component over its standard deviation, (m,).
        size: Expected size of each component, (m,) [unit].
        smallest_visible: Six standard deviations of the size, (m,) [unit]; infinite where the data
            do not move at all.
        block_z: Length of an effect's score, sqrt(s' I^-1 s), (num_effects,); |z| for one
            component.
        confounding: Cosines between what the base parameters cannot absorb, (m, m).
        information: G'G~ in standardized sizes, (m, m).
    """

    names: tuple[str, ...]
    z: Array
    size: Array
    smallest_visible: Array
    block_z: Array
    confounding: Array
    information: Array


def screen(problem: Problem, residual: Array, jacobian: Array, x: Array) -> Screen:
    """Scores from a linearization at the null fit.

    Args:
        problem: Fitted problem with all candidate effects, in this order.
        residual: Whitened residual at the null fit, (N,).
        jacobian: Whitened slopes of base parameters and components, (N, num_base + m).
        x: Standardized coordinates of the null fit, sizes zero, (num_base + m,).
    """
    n = problem.num_base
    j, g = jacobian[:, :n], jacobian[:, n:]
    inner = linalg.inv(j.T @ j + np.eye(n)) if n else np.zeros((0, 0))
    absorbed = inner @ (j.T @ g)
    information = g.T @ g - (j.T @ g).T @ absorbed
    # the second part vanishes at the exact optimum; so written, an inexact one does no harm
    score = g.T @ residual - absorbed.T @ (j.T @ residual - x[:n])
    diagonal = np.clip(np.diag(information), 0.0, None)
    # a column that the base parameters absorb up to rounding carries no information
    blind = diagonal <= 1e-12 * np.sum(g**2, axis=0) + 1e-300
    root = np.where(blind, np.inf, np.sqrt(diagonal))
    unit = problem.size_units  # at sizes of zero, where slopes by size and by coordinate agree
    tilde = g - j @ absorbed
    length = np.linalg.norm(tilde, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.nan_to_num((tilde.T @ tilde) / np.outer(length, length))
    blocks = []
    for effect in problem.effects:
        c = [i - n for i in problem.columns_of(effect)]
        seen = [i for i in c if not blind[i]]
        s, sub = score[seen], information[np.ix_(seen, seen)]
        blocks.append(np.sqrt(max(float(s @ np.linalg.pinv(sub) @ s), 0.0)) if seen else 0.0)
    with np.errstate(divide="ignore"):
        smallest = np.where(blind, np.inf, VISIBLE / root) * unit
    return Screen(
        names=problem.names[n:],
        z=score / root,
        size=score / root**2 * unit,
        smallest_visible=smallest,
        block_z=np.array(blocks),
        confounding=cosine,
        information=information,
    )
