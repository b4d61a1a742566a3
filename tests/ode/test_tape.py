"""What a tape computes once, and its own sines and exponentials against many digits."""

import numpy as np
import pytest
import torch

from diffsim.ode import Ode

RNG = np.random.default_rng(4)
ULPS = {"sin": 1.0, "cos": 1.0, "exp": 1.0, "tanh": 2.0}
FUNCTIONS = Ode(rates={"x": "0*x"}, readings={name: f"{name}(x)" for name in ULPS})
USUAL = np.concatenate(
    [
        RNG.uniform(-9.0, 9.0, 600),
        RNG.normal(size=600) * 10.0 ** RNG.uniform(-12.0, 6.0, 600),
        RNG.uniform(-708.0, 708.0, 300),
        RNG.integers(1, 600_000, 600) * (0.5 * np.pi),  # where a sine or cosine vanishes
        [0.0, -0.0, 5e-324, -1e-310, 0.625, 709.7, -745.0, 22.0, 1e6, 999_999.9, -1e22, 1e150],
    ]
)


def values_at(x: np.ndarray, ode: Ode = FUNCTIONS) -> np.ndarray:
    times = torch.tensor([0.0, 1.0], dtype=torch.float64)
    start = torch.from_numpy(np.ascontiguousarray(x))[:, None]
    return ode.solve(times, start, finite=False)[0][:, 0].numpy()


@pytest.mark.reference
@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 60, reason="no number has more digits here")
@pytest.mark.parametrize("name", ULPS)
def test_elementary_functions_are_right_to_the_last_digit(name):
    found = values_at(USUAL)[:, list(ULPS).index(name)]
    with np.errstate(over="ignore", under="ignore"):
        exact = getattr(np, name)(USUAL.astype(np.longdouble))
        nearest = exact.astype(np.float64)
    whole = np.isfinite(nearest)
    np.testing.assert_array_equal(found[~whole], nearest[~whole])
    errors = np.abs(found[whole] - exact[whole]) / np.spacing(np.abs(nearest[whole]))
    assert errors.max() < ULPS[name], USUAL[whole][errors.argmax()]


@pytest.mark.property
def test_a_lane_does_not_see_what_stands_beside_it():
    found = values_at(USUAL)
    np.testing.assert_array_equal(values_at(USUAL[::-1])[::-1], found)
    some = np.concatenate([RNG.integers(0, len(USUAL), 40), np.arange(-12, 0)])
    alone = [values_at(USUAL[[place]])[0] for place in some]
    np.testing.assert_array_equal(alone, found[some])


def test_zeros_infinities_and_what_is_no_number():
    assert np.signbit(values_at(np.array([-0.0]))).tolist() == [[True, False, False, True]]
    far = Ode(rates={"x": "0*x"}, readings={n: f"{n}(x*1e300*1e300)" for n in ULPS})
    with np.errstate(invalid="ignore"):
        expected = [[getattr(np, name)(x) for name in ULPS] for x in (np.inf, -np.inf)]
    np.testing.assert_array_equal(values_at(np.array([1.0, -1.0]), far), expected)
    lost = Ode(rates={"x": "0*x"}, readings={n: f"{n}(log(x))" for n in ULPS})
    assert np.isnan(values_at(np.array([-1.0]), lost)).all()


def test_a_tape_computes_again_only_what_has_changed():
    ode = Ode(
        rates={"x": "-sin(a*a)*x*cos(b*t)"},
        readings={"y": "cos(b*t)*exp(x) + a", "z": "x/sin(a*a)"},
        parameters=["a", "b"],
    )
    # a*a, sin, minus; b*t, cos; two products; exp, product and sum as one, ratio
    ends = ode.problem(torch.arange(2.0).double(), 1, 1)["ends"]
    assert ends.tolist() == [3, 5, 7, 10]


def test_equal_products_cancel_to_zero():
    """A sum of two products rounds both: one of them fused would leave what rounding took."""
    ode = Ode(rates={"x": "0*x"}, readings={"y": "x*a - b*c"}, parameters=["a", "b", "c"])
    x, a = 0.1, 0.7
    readings, _ = ode.solve(
        torch.tensor([0.0, 1.0]).double(),
        torch.tensor([x], dtype=torch.float64),
        parameters=torch.tensor([a, a, x], dtype=torch.float64),
    )
    assert not readings.any()
