"""A body of 300 m, or of 0.26 Pa, is made, and somebody is told."""

import warnings

import pytest
import torch

from diffsim import mesh, soft
from diffsim.soft.plausible import LockingWarning, UnitsWarning, expected_stiffness
from tests.soft.test_elements import tip_share


def body(size=0.1, modulus=2.6e5, density=1070.0, nu=0.45, element="standard", bar=None):
    bar = bar or mesh.hex_box(cells=(2, 1, 1), size=(size, 0.3 * size, 0.3 * size))
    return soft.SoftBody(
        bar, dt=0.01, youngs_modulus=modulus, poissons_ratio=nu, density=density, element=element
    )


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


def test_thin_bodies_of_elements_that_nobody_chose_are_told():
    size = (0.1, 0.01, 0.01)
    with pytest.warns(LockingWarning, match=r"2\.1 times .* one cell.* at nu 0\.49") as told:
        body(bar=mesh.hex_box((10, 1, 1), size), nu=0.49, element=None)
    assert told[0].filename == __file__
    with pytest.warns(LockingWarning, match=r"2 cells .*split_tets"):
        body(bar=mesh.tet_box((20, 2, 2), size), element=None)
    quiet = (
        {"bar": mesh.hex_box((60, 6, 6), size)},
        {"bar": mesh.hex_box((2, 2, 2), (0.01, 0.01, 0.01)), "nu": 0.49},
        {"bar": mesh.hex_box((10, 1, 1), size), "element": "assumed_strain"},
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in quiet:
            body(**{"element": None, **given})


@pytest.mark.parametrize("cells", [(10, 2, 2), (20, 2, 2), (20, 4, 4)])
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49])
def test_the_stiffness_told_is_what_a_beam_has(nu, cells):
    told, count = expected_stiffness(mesh.hex_box(cells, (1.0, 0.1, 0.1)), nu)
    assert count == cells[2]
    assert told == pytest.approx(1.0 / tip_share(cells, nu, element="standard")[0], rel=0.1)
