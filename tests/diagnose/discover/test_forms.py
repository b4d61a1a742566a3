"""Each form finds its own numbers in a curve that is known, in units of the variable."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from diffsim.diagnose.discover.forms import FORMS, FORMS_THROUGH_ZERO, Curve, fit_forms

LOW, HIGH = 3.0, 11.0
MID = 0.5 * (LOW + HIGH)
MATH: dict[str, Any] = {"max": np.maximum, "exp": np.exp, "tanh": np.tanh, "abs": np.abs}
#: the same in plain numpy, in units of the variable: (size, numbers) of each form, then the curve
ONE_WAY = [
    (2.5, {}, lambda u: 2.5 * (u - MID)),
    (-0.4, {}, lambda u: -0.4 * (u - MID) ** 2),
    (1.2, {"rate": 0.3}, lambda u: 1.2 * (np.exp(0.3 * (u - MID)) - 1.0)),
    (0.7, {"threshold": 6.2}, lambda u: 0.7 * np.clip(u - 6.2, 0.0, None)),
    (0.7, {"threshold": 7.9}, lambda u: 0.7 * np.clip(7.9 - u, 0.0, None)),
    (3.0, {"middle": 5.5, "width": 1.3}, lambda u: 3.0 * np.tanh((u - 5.5) / 1.3)),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (u - LOW + 0.9)),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (u - LOW + 0.9) ** 2),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (HIGH - u + 0.9) ** 2),
    (0.05, {"exponent": 1.7}, lambda u: 0.05 * (u - LOW) ** 1.7),
]
THROUGH_ZERO = [
    (2.5, lambda u: 2.5 * u),
    (-0.4, lambda u: -0.4 * u**2),
    (-0.4, lambda u: -0.4 * u * np.abs(u)),
    (0.2, lambda u: 0.2 * u**3),
    (1.5, lambda u: 1.5 * np.abs(u)),
]


def curve_of(truth, low, high, sd=1e-3):
    """A curve told at each of its points by a factor of its own."""
    u = np.linspace(low, high, 61)
    values = np.asarray(truth(u))
    return Curve(u, values, np.eye(len(u)), values, sd**2 * np.eye(len(u)))


def read(fitted, u):
    """The law by its formula, as a user reads it."""
    numbers = {name: value for name, (value, _) in fitted.numbers.items()}
    return eval(fitted.term, {**MATH, **numbers, "u": u, "size": fitted.size})


@pytest.mark.reference
@pytest.mark.parametrize("k", range(len(FORMS)), ids=[f"{k}-{f.name}" for k, f in enumerate(FORMS)])
def test_a_form_finds_its_own_numbers(k):
    size, numbers, truth = ONE_WAY[k]
    curve = curve_of(truth, LOW, HIGH)
    found = fit_forms(curve)
    own = next(f for f in found if f.form is FORMS[k])
    assert found[0].nats > own.nats - 1.0  # others may bend as it does, none fits better
    assert own.size == pytest.approx(size, rel=1e-3)
    assert {n: v for n, (v, _) in own.numbers.items()} == pytest.approx(numbers, rel=1e-3)
    np.testing.assert_allclose(read(own, curve.u), curve.values, atol=1e-3)


@pytest.mark.reference
@pytest.mark.parametrize("k", range(len(FORMS_THROUGH_ZERO)))
def test_a_form_through_zero_finds_its_size(k):
    size, truth = THROUGH_ZERO[k]
    curve = curve_of(truth, -4.0, 5.0)
    own = next(f for f in fit_forms(curve) if f.form is FORMS_THROUGH_ZERO[k])
    assert own.size == pytest.approx(size, rel=1e-6)
    np.testing.assert_allclose(read(own, curve.u), curve.values, atol=1e-9)


def test_forms_through_zero_are_for_variables_that_go_through_it():
    found = fit_forms(curve_of(lambda u: 2.0 * u, LOW, HIGH))
    assert not {id(f.form) for f in found} & {id(f) for f in FORMS_THROUGH_ZERO}


@pytest.mark.reference
def test_a_numbers_sd_is_that_of_the_curve():
    """Of a threshold by many curves of one noise: scatter and stated sd are one."""
    (_, _, truth), rng = ONE_WAY[3], np.random.default_rng(0)
    clean = curve_of(truth, LOW, HIGH, sd=0.05)
    places, told = [], []
    for _ in range(30):
        values = clean.values + 0.05 * rng.normal(size=len(clean.u))
        found = fit_forms(Curve(clean.u, values, clean.basis, values, clean.covariance))
        place, sd = next(f for f in found if f.form is FORMS[3]).numbers["threshold"]
        places.append(place)
        told.append(sd)
    assert np.mean(places) == pytest.approx(6.2, abs=0.1)
    assert np.std(places) == pytest.approx(np.mean(told), rel=0.5)


def test_what_the_record_does_not_tell_weighs_nothing():
    """Beyond the middle the factors have hardly an sd: only the rest tells a line's slope."""
    u = np.linspace(LOW, HIGH, 61)
    is_known = u < MID
    values = np.where(is_known, 2.0 * (u - MID), 50.0)
    sd = np.where(is_known, 1e-3, 1e3)
    found = fit_forms(Curve(u, values, np.eye(61), values, np.diag(sd**2)))
    line = next(f for f in found if f.form is FORMS[0])
    assert line.size == pytest.approx(2.0, rel=1e-2)
