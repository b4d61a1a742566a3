"""A body of 300 m, or of 0.26 Pa, is made, and somebody is told."""

import warnings

import pytest
import torch

from diffsim import mesh, soft
from diffsim.soft.plausible import UnitsWarning


def body(size=0.1, modulus=2.6e5, density=1070.0):
    bar = mesh.hex_box(cells=(2, 1, 1), size=(size, 0.3 * size, 0.3 * size))
    return soft.SoftBody(bar, dt=0.01, youngs_modulus=modulus, poissons_ratio=0.45, density=density)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"size": 300.0}, "the body is 300 m long; nodes in millimeters"),
        ({"modulus": 0.26}, "youngs_modulus is 0.26 Pa; 1 MPa is 1e6"),
        ({"density": 1.07e6}, r"density is 1.07e\+06 kg/m\^3"),
        ({"size": 300.0, "modulus": 0.26}, "300 m long.*; youngs_modulus is 0.26 Pa"),
    ],
)
def test_forgotten_units_are_told(given, words):
    with pytest.warns(UnitsWarning, match=words) as told:
        body(**given)
    assert told[0].filename == __file__  # the line that made the body


def test_one_odd_element_is_enough():
    with pytest.warns(UnitsWarning, match="youngs_modulus is 3 Pa"):
        body(modulus=torch.tensor([2e5, 3.0], dtype=torch.float64))


def test_usual_bodies_and_massless_ones_are_quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body()
        body(size=0.002, modulus=1e3)
        body(modulus=2e11, density=7850.0)
