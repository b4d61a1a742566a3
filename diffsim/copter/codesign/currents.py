"""Currents of a design in hover, with first and second derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffsim.copter.codesign.metrics import CurrentModel
from diffsim.copter.codesign.space import Shape
from diffsim.copter.codesign.wrench import Rotors
from diffsim.core.arrays import Array

_LEAST_THRUST = 1e-6  # of the limit; keeps second derivatives of u^alpha, alpha < 2, finite


@dataclass(frozen=True)
class Currents:
    """Currents in hover and what their derivatives are made of.

    Attributes:
        value: Current of each rotor, (n_rotors,) [A].
        by_v, by_z: First derivatives, (n_rotors,) and (n_rotors, p).
        by_v_v, by_v_z: Second ones, (n_rotors,) and (n_rotors, p).
        by_z_z: (n_rotors,) times d_share d_share', d_share (p,).
        by_mass: (n_rotors,) times the second derivative of m(s) [A/kg].
    """

    value: Array
    by_v: Array
    by_z: Array
    by_v_v: Array
    by_v_z: Array
    by_z_z: Array
    d_share: Array
    by_mass: Array


def hover_currents(
    v: Array, shape: Shape, rotors: Rotors, model: CurrentModel, *, scaled: bool
) -> Currents:
    """Currents of the rotors in hover without load.

    I = a (u_max v share)^e; share = m / m0 where v carries m0 g (``scaled``), else 1.
    """
    share = shape.mass / rotors.mass if scaled else 1.0
    d_share = shape.d_mass * (rotors.length / rotors.mass if scaled else 0.0)
    full = model.scale * rotors.max_thrusts**model.exponent
    e, w = model.exponent, np.maximum(v, 0.0) * share
    slope = e * full * w ** (e - 1.0)
    bend = e * (e - 1.0) * full * np.maximum(w, _LEAST_THRUST) ** (e - 2.0)
    return Currents(
        value=full * w**e,
        by_v=slope * share,
        by_z=np.outer(slope * v, d_share),
        by_v_v=bend * share**2,
        by_v_z=np.outer(bend * share * v + slope, d_share),
        by_z_z=bend * v**2,
        d_share=d_share,
        by_mass=slope * v / rotors.mass if scaled else np.zeros(len(v)),
    )
