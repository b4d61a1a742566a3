"""The co-design program: derivatives against finite differences, balance against the vehicle."""

import itertools

import numpy as np
import pytest
import torch

from diffsim.copter.codesign.cases import Demands, flight_cases
from diffsim.copter.codesign.hessian import lagrangian_hessian
from diffsim.copter.codesign.limits import Limits, Scales
from diffsim.copter.codesign.metrics import CurrentModel
from diffsim.copter.codesign.polynomial import fit
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.space import ShapeModel
from tests.copter.codesign_designs import arm_copter

FIVE = np.arange(5) * 2.0 * np.pi / 5.0 + 0.1
ALL = {
    "payload": 1.0,
    "current": 0.3,
    "max_current": 0.2,
    "size": 0.2,
    "cost": 0.1,
    "mass": 0.2,
    "authority": 0.3,
    "one_rotor_out": 0.2,
}


def program(weights, demands=None, **limits):
    model = ShapeModel(arm_copter(FIVE))
    scales = Scales(3.0, 1.0, 1.0, 300.0, float(model.vehicle.mass), 0.05, 0.3)
    currents = CurrentModel(np.linspace(0.2, 0.4, 5), np.linspace(1.2, 1.6, 5))
    spins = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    bare = Program(model, spins, weights, [], Limits(), scales, currents)
    cases = flight_cases(
        weights, demands or Demands(authority=(0.3, 0.2, 0.05)), bare.rotors, bare.radii
    )
    return Program(model, spins, weights, cases, Limits(**limits), scales, currents)


def differences(function, x, h=1e-6):
    return np.stack(
        [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))], -1
    )


@pytest.mark.grad
@pytest.mark.parametrize("weights", [ALL, {"response": 0.4}], ids=["all", "response"])
@pytest.mark.parametrize("name", ["objective", "equalities", "inequalities"])
def test_first_derivatives(name, weights):
    whole = program(weights, None if weights is ALL else Demands(), clearance=0.02)
    x = np.random.default_rng(0).uniform(0.2, 0.8, whole.num_all)
    evaluate = getattr(whole, name)
    slope = differences(lambda y: np.atleast_1d(evaluate(y)[0]), x)
    assert np.abs(slope).max() > 0.1
    # central differences at h = 1e-6: rounding 1e-10 of values of order 10
    np.testing.assert_allclose(np.atleast_2d(evaluate(x)[1]), slope, atol=2e-8)


@pytest.mark.grad
@pytest.mark.parametrize("payload", [0.0, 1.0])
def test_second_derivatives(payload):
    weights = {name: w for name, w in ALL.items() if payload or name != "payload"}
    whole = program(weights, Demands(), clearance=0.02)
    rng = np.random.default_rng(1)
    x = rng.uniform(0.2, 0.8, whole.num_all)
    equal = rng.standard_normal(len(whole.equalities(x)[0]))
    unequal = rng.standard_normal(len(whole.inequalities(x)[0]))

    def gradient(y):
        slope = 0.7 * whole.objective(y)[1] + equal @ whole.equalities(y)[1]
        return slope + unequal @ whole.inequalities(y)[1]

    hessian = lagrangian_hessian(whole, x, equal, unequal, 0.7)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12)
    np.testing.assert_allclose(hessian, differences(gradient, x), atol=2e-7)


def test_balance_is_that_of_the_vehicle():
    whole = program({"size": 1.0}, Demands())
    rng = np.random.default_rng(2)
    x = rng.uniform(0.2, 0.8, whole.num_all)
    x[whole.at["z"]] *= 0.2
    x[whole.at["d"]] = (v := rng.standard_normal((5, 3))).ravel() / np.repeat(
        np.linalg.norm(v, axis=1), 3
    )
    s, d, gamma, _, v = whole.split(x)
    design = arm_copter(FIVE, spins=[1.0, -1.0, 1.0, -1.0, 1.0])
    vehicle = design.multicopter(torch.tensor(s), torch.tensor(d))
    u = v[0] * whole.rotors.max_thrusts
    force = vehicle.force_matrix.numpy() @ u + float(vehicle.weight) * gamma
    torque = vehicle.torque_matrix.numpy() @ u
    unit = whole.rotors.weight
    expected = np.concatenate([force / unit, torque / (unit * whole.rotors.length)])
    np.testing.assert_allclose(whole.equalities(x)[0][:6], expected, atol=1e-12)


def test_shapes_are_those_of_the_design():
    design = arm_copter(FIVE)
    model = ShapeModel(design)
    assert model.is_polynomial
    s = model.start + np.array([0.1, -0.2, 0.05, 0.2, -0.1])
    shape, vehicle = model.at(s), design.multicopter(torch.tensor(s))
    assert shape.mass == pytest.approx(float(vehicle.mass), rel=1e-12)
    assert shape.size == pytest.approx(float(design.size(torch.tensor(s))), rel=1e-12)
    np.testing.assert_allclose(shape.positions, vehicle.positions.numpy(), atol=1e-12)


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_a_polynomial_is_found_about_any_origin(degree):
    rng = np.random.default_rng(degree)
    powers = [p for p in itertools.product(range(degree + 1), repeat=3) if sum(p) <= degree]
    factors = rng.normal(size=(2, len(powers)))

    def made(s):
        return factors @ np.prod(s ** np.array(powers), axis=1)

    points = (rng.uniform(-1.0, 1.0, 3) for _ in iter(int, 1))
    origin, (s, *weights) = rng.uniform(-0.5, 0.5, 3), rng.uniform(-1.0, 1.0, (2, 3))
    found, w = fit(made, points, origin, 0.5), weights[0][:2]
    np.testing.assert_allclose(found.at(s)[0], made(s), atol=1e-10)
    np.testing.assert_allclose(found.at(s)[1], differences(made, s), atol=1e-7)
    slope = differences(lambda y: w @ found.at(y)[1], s)
    np.testing.assert_allclose(found.hessian(s, w), slope, atol=1e-7)
    assert fit(lambda s: np.exp(s), points, origin, 0.5) is None


def test_a_design_that_is_no_polynomial_is_differentiated_by_torch():
    design = arm_copter(FIVE)
    design.size = lambda s: torch.exp(s).sum()
    model = ShapeModel(design)
    assert not model.is_polynomial
    exact = ShapeModel(arm_copter(FIVE))
    s = model.start + 0.05
    weights = np.random.default_rng(4).standard_normal((5, 3))
    np.testing.assert_allclose(model.at(s).d_positions, exact.at(s).d_positions, atol=1e-10)
    np.testing.assert_allclose(
        model.hessian(s, 0.5, 0.0, 0.0, weights),
        exact.hessian(s, 0.5, 0.0, 0.0, weights),
        atol=1e-9,
    )
