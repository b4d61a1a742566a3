"""Do the contact stories end as told? Each runs at its small size."""

import math

import pytest

from tests.examples.stories import EXAMPLES, load_story

pytestmark = pytest.mark.example


@pytest.fixture
def story(monkeypatch):
    """Load a story as it loads when run as a script: beside its helper module."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "contact"))

    return lambda name: load_story(f"contact/{name}.py")


def test_rolling_sphere_gradient_is_the_central_difference(story, tmp_path):
    picture = tmp_path / "ball.png"
    numbers = story("rolling_sphere").main(0.1, 20, out=str(picture))
    for name in ("sticking", "friction 0.3"):
        exact = numbers[f"{name}: the same, tolerance 1e-9"]
        # third derivatives times 1e-6, and the solver's 1e-9 over the step of 1e-3
        assert exact == pytest.approx(numbers[f"{name}: central difference"], rel=1e-3)
        assert numbers[f"{name}: most nodes in contact"] >= 1
    assert numbers["sticking: travel [m]"] > 0.1 > numbers["friction 0.3: travel [m]"] > 0.0
    assert picture.stat().st_size > 10_000


def test_slope_sticks_and_slides_like_a_block(story, tmp_path):
    picture = tmp_path / "slope.png"
    numbers = story("slope").main(0.05, (0.20, 0.10), 0.5, str(picture))
    assert abs(numbers["complementarity 0.20"]) < 0.005  # it shears, then sticks
    # a soft duck shears while it starts: it is ahead of the block by some mm
    ahead = numbers["complementarity 0.10"] - numbers["rigid 0.10"]
    assert 0.0 < ahead < 0.02
    assert numbers["penalty 0.10"] > numbers["complementarity 0.10"]  # viscous below its cap
    assert picture.stat().st_size > 10_000


@pytest.mark.short_of("test_duck_slide_comes_nearer_to_its_target")
def test_duck_slide_in_short(story):
    numbers = story("duck_slide").main(0.08, max_simulations=2)
    assert 0.0 < numbers["error_after_m"] <= numbers["error_before_m"] < 1.0


@pytest.mark.slow
def test_duck_slide_comes_nearer_to_its_target(story, tmp_path):
    picture = tmp_path / "duck.png"
    numbers = story("duck_slide").main(0.04, max_simulations=4, out=str(picture))
    assert numbers["error_after_m"] < 0.8 * numbers["error_before_m"]
    assert picture.stat().st_size > 10_000


def test_napkin_touches_with_all_lower_nodes_on_a_large_ball(story, tmp_path):
    picture = tmp_path / "napkin.png"
    numbers = story("napkin").main((10,), 20, str(picture))
    shares = [value for name, value in numbers.items() if name.endswith("share")]
    assert shares == sorted(shares)
    assert math.isclose(shares[-1], 0.5, abs_tol=0.02)
    assert picture.stat().st_size > 10_000
