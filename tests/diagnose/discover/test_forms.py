"""Each form finds its own numbers in a curve that is known, in units of the variable."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from diffsim.diagnose.discover import forms as fitting
from diffsim.diagnose.discover.forms import (
    FACTORS,
    FACTORS_ABOVE_ZERO,
    FACTORS_THROUGH_ZERO,
    FORMS,
    FORMS_ABOVE_ZERO,
    FORMS_THROUGH_ZERO,
    FORMS_TO_BOTH_SIDES,
    LawMisfit,
    fit_forms,
)

LOW, HIGH = 3.0, 11.0
MID = 0.5 * (LOW + HIGH)
MATH: dict[str, Any] = {
    "max": np.maximum,
    "min": np.minimum,
    "exp": np.exp,
    "tanh": np.tanh,
    "abs": np.abs,
    "sqrt": np.sqrt,
}
#: the same in plain numpy, in units of the variable: (size, numbers) of each form, then the curve
ONE_WAY = [
    (2.5, {}, lambda u: 2.5 * (u - MID)),
    (-0.4, {}, lambda u: -0.4 * (u - MID) ** 2),
    (1.2, {"rate": 0.3}, lambda u: 1.2 * np.exp(0.3 * (u - MID))),
    (0.7, {"threshold": 6.2}, lambda u: 0.7 * np.clip(u - 6.2, 0.0, None)),
    (0.7, {"threshold": 7.9}, lambda u: 0.7 * np.clip(7.9 - u, 0.0, None)),
    (3.0, {"middle": 5.5, "width": 1.3}, lambda u: 3.0 * np.tanh((u - 5.5) / 1.3)),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (u - LOW + 0.9)),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (u - LOW + 0.9) ** 2),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (HIGH - u + 0.9)),
    (0.8, {"distance": 0.9}, lambda u: 0.8 / (HIGH - u + 0.9) ** 2),
    (0.05, {"exponent": 1.7}, lambda u: 0.05 * (u - LOW) ** 1.7),
]
OF_ZERO = (*FORMS_THROUGH_ZERO, *FORMS_TO_BOTH_SIDES)
THROUGH_ZERO = [
    (2.5, lambda u: 2.5 * u),
    (-0.4, lambda u: -0.4 * u**2),
    (-0.4, lambda u: -0.4 * u * np.abs(u)),
    (0.2, lambda u: 0.2 * u**3),
    (1.5, lambda u: 1.5 * np.abs(u)),
    (-0.7, lambda u: -0.7 * np.sign(u) * np.abs(u) ** 0.6),
    (0.9, lambda u: 0.9 * u / (1.0 + (u / 1.7) ** 2)),
    (-0.7, lambda u: -0.7 * np.sign(u) * np.clip(np.abs(u) - 1.3, 0.0, None)),
    (0.9, lambda u: 0.9 * np.clip(np.abs(u) - 2.1, 0.0, None)),
    (-0.4, lambda u: -0.2 * (np.tanh((u - 1.85) / 0.2) + np.tanh((u + 1.85) / 0.2))),
    (0.6, lambda u: 0.3 * (np.tanh((np.abs(u) - 2.05) / 0.1) + 1.0)),
]


def told_of(truth, low, high, sd=1e-3, of_number=False):
    """A law that the record tells at each point by itself."""
    u = np.linspace(low, high, 61)
    return LawMisfit(u, np.eye(61) / sd, np.asarray(truth(u)) / sd, of_number)


def values_of(told):
    return told.target / told.root[0, 0]


def read(fitted, u):
    """The law by its formula, as a user reads it."""
    numbers = {name: value for name, (value, _) in fitted.numbers.items()}
    return eval(fitted.term, {**MATH, **numbers, "u": u, "size": fitted.size})


def fitted_alone(monkeypatch, form, told):
    """A form without its neighbors, which may do the same."""
    for group in (name for name in dir(fitting) if name.startswith(("FORMS", "FACTORS"))):
        forms = getattr(fitting, group)
        monkeypatch.setattr(fitting, group, tuple(f for f in forms if f is form))
    return fit_forms(told)[0]


@pytest.mark.reference
@pytest.mark.parametrize("k", range(len(FORMS)), ids=[f"{k}-{f.name}" for k, f in enumerate(FORMS)])
def test_a_form_finds_its_own_numbers(k):
    size, numbers, truth = ONE_WAY[k]
    told = told_of(truth, LOW, HIGH)
    own = fit_forms(told)[0]
    assert own.form is FORMS[k]
    assert own.size == pytest.approx(size, rel=1e-3)
    assert {n: v for n, (v, _) in own.numbers.items()} == pytest.approx(numbers, rel=1e-3)
    np.testing.assert_allclose(read(own, told.u), values_of(told), atol=1e-3)


@pytest.mark.reference
@pytest.mark.parametrize("k", range(len(OF_ZERO)))
def test_a_form_through_zero_finds_its_size(k):
    size, truth = THROUGH_ZERO[k]
    told = told_of(truth, -4.0, 5.0)
    own = fit_forms(told)[0]
    assert own.form is OF_ZERO[k]
    assert own.size == pytest.approx(size, rel=1e-3 if own.numbers else 1e-6)
    np.testing.assert_allclose(
        read(own, told.u), values_of(told), atol=1e-3 if own.numbers else 1e-9
    )
    if "exponent" in own.numbers:  # its slope is finite: near zero it is a line
        assert own.numbers["exponent"][0] == pytest.approx(0.6, abs=2e-3)
        assert read(own, np.array([0.0, 1e-9])) == pytest.approx([0.0, 0.0], abs=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("k", range(len(FORMS)), ids=[f"{k}-{f.name}" for k, f in enumerate(FORMS)])
def test_a_form_may_be_zero_anywhere(monkeypatch, k):
    """A force of what is recorded is none at the weather's mean, not in the middle of the range."""
    size, _, truth = ONE_WAY[k]
    told = told_of(lambda u: truth(u) + 4.0 * size, LOW, HIGH)
    own = fitted_alone(monkeypatch, FORMS[k], told)
    np.testing.assert_allclose(read(own, told.u), values_of(told), atol=1e-3 * abs(size))
    assert own.size == pytest.approx(size, rel=1e-2)


def test_a_line_says_where_it_is_zero():
    told = told_of(lambda u: 0.3 * (u - 4.2), LOW, HIGH)
    own = fit_forms(told)[0]
    assert (own.form.name, own.term) == ("line", "size*(u - zero)")
    value, sd = own.numbers["zero"]
    assert value == pytest.approx(4.2, abs=1e-6) and 0.0 < sd < 0.01


@pytest.mark.reference
def test_a_number_falls_to_both_sides_as_iron_saturates():
    """tanh(s i)/(s i) of a current, whatever the number's own value makes of the level."""
    told = told_of(lambda u: np.tanh(0.7 * u) / (0.7 * u) - 0.8, -2.0, 2.3, 2e-3, of_number=True)
    own = fit_forms(told)[0]
    assert own.form is FACTORS_THROUGH_ZERO[0] and not own.form.signed
    assert own.size == pytest.approx(2.0 / 3.0 * 0.7**2, rel=0.15)  # what both bend by at zero
    # the number's own value makes of it what height and level it likes
    terms = np.stack([1.0 + read(own, told.u), np.ones(len(told.u))], 1)
    height, level = np.linalg.lstsq(terms, values_of(told), rcond=None)[0]
    np.testing.assert_allclose(terms @ [height, level], values_of(told), atol=0.01)


@pytest.mark.parametrize("height", [0.7, 1.4])
def test_a_number_that_was_bent_is_multiplied_by_what_is_missing(height):
    """A shaker's saturating magnet was a curve without a formula: beside bumps its force constant
    had become a share lower."""
    law = lambda u: height / np.sqrt(1.0 + 0.17 * u**2) - 1.0  # noqa: E731
    own = fit_forms(told_of(law, -2.7, 2.3, 2e-3, of_number=True))[0]
    assert own.form is FACTORS_THROUGH_ZERO[0] and own.size == pytest.approx(0.17, rel=0.02)


@pytest.mark.reference
def test_a_number_may_be_multiplied_by_an_exponential():
    told = told_of(lambda u: np.expm1(-0.24 * (u - MID)), LOW, HIGH, of_number=True)
    own = fit_forms(told)[0]
    assert own.form is FACTORS[0] and own.numbers == {}
    assert own.size == pytest.approx(-0.24, rel=1e-3)
    np.testing.assert_allclose(read(own, told.u), values_of(told), atol=1e-3)


@pytest.mark.reference
@pytest.mark.parametrize("exponent", [-0.5, 2.5])
def test_a_power_of_what_stays_above_zero(exponent):
    """Of a law with a level of its own, and of what a number is multiplied by."""
    told = told_of(lambda u: 0.4 * u**exponent - 0.1, LOW, HIGH, sd=1e-4)
    own = fit_forms(told)[0]
    assert own.form is FORMS_ABOVE_ZERO[0] and own.size == pytest.approx(0.4, rel=1e-2)
    assert own.numbers["exponent"][0] == pytest.approx(exponent, rel=1e-2)
    np.testing.assert_allclose(read(own, told.u), values_of(told), atol=1e-4)
    told = told_of(lambda u: (u / MID) ** exponent - 1.0, LOW, HIGH, of_number=True)
    own = fit_forms(told)[0]
    assert own.form is FACTORS_ABOVE_ZERO[0] and own.numbers == {}
    assert own.size == pytest.approx(exponent, rel=1e-3)
    np.testing.assert_allclose(read(own, told.u), values_of(told), atol=1e-3)


def test_what_the_record_cannot_tell_apart_is_said_once():
    """An exponential that hardly bends is a line, which has a number less."""
    found = fit_forms(told_of(lambda u: 0.02 * np.exp(0.02 * (u - MID)), LOW, HIGH, sd=1e-3))
    assert found[0].form.name == "line"
    for k, first in enumerate(found):
        assert not any(first.stands_for(other) for other in found[k + 1 :])


def test_a_line_stands_for_what_slopes_cannot_tell_from_it():
    """A resistance over a temperature was an exponential, 0.8 % off its line at 17,000 nats, whose
    size and rate had no ends."""
    law = lambda u: -3.2 * np.expm1(-1.15e-3 * (u - 319.0))  # noqa: E731
    found = fit_forms(told_of(law, 290.0, 350.0, sd=2e-4, of_number=True))
    assert "exponential" not in {f.form.name for f in found if f.numbers}
    line = next(f for f in found if f.form.name == "line")
    assert line.size == pytest.approx(3.7e-3, rel=0.01)
    # of curves that bend by more, the better one is kept
    bent = fit_forms(told_of(lambda u: np.expm1(0.01 * (u - 319.0)), 290.0, 350.0, sd=2e-4))
    assert bent[0].form.name == "exponential"


@pytest.mark.reference
@pytest.mark.parametrize("power", [0.5, 1.0])
def test_a_number_may_fall_from_zero_on_to_one_side(power):
    """A pump whose flow falls with its speed, driven from 12 to 95 %: the curve begins at zero
    speed, though no run goes there. The second form falls with the square."""
    law = lambda u: 1.3 * (1.0 + 2.4 * u**2) ** -power - 1.0  # noqa: E731
    own = fit_forms(told_of(law, 0.12, 0.95, of_number=True))[0]
    assert own.form is FACTORS_THROUGH_ZERO[int(power == 1.0)]
    assert own.size == pytest.approx(2.4, rel=0.02)


def test_forms_through_zero_are_for_variables_that_go_through_it():
    found = fit_forms(told_of(lambda u: 2.0 * u, LOW, HIGH))
    assert not {id(f.form) for f in found} & {id(f) for f in OF_ZERO}


@pytest.mark.story  # many records
@pytest.mark.reference
def test_a_numbers_sd_is_that_of_the_record():
    """Of a threshold by many records of one noise: scatter and stated sd are one."""
    (_, _, truth), rng = ONE_WAY[3], np.random.default_rng(0)
    clean = told_of(truth, LOW, HIGH, sd=0.05)
    places, sds = [], []
    for _ in range(30):
        found = fit_forms(replace(clean, target=clean.target + rng.normal(size=len(clean.u))))
        place, sd = next(f for f in found if f.form is FORMS[3]).numbers["threshold"]
        places.append(place)
        sds.append(sd)
    assert np.mean(places) == pytest.approx(6.2, abs=0.1)
    assert np.std(places) == pytest.approx(np.mean(sds), rel=0.5)


def test_what_the_record_does_not_tell_weighs_nothing():
    """Beyond the middle hardly anything is told: only the rest tells a line's slope."""
    u = np.linspace(LOW, HIGH, 61)
    is_known = u < MID
    values = np.where(is_known, 2.0 * (u - MID), 50.0)
    sd = np.where(is_known, 1e-3, 1e3)
    found = fit_forms(LawMisfit(u, np.diag(1.0 / sd), values / sd))
    line = next(f for f in found if f.form is FORMS[0])
    assert line.size == pytest.approx(2.0, rel=1e-2)
