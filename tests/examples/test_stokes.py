"""Do the stories of slow flow end as told? Each runs at its small size."""

import pytest

from tests.examples.stories import load_story

pytestmark = pytest.mark.example


@pytest.mark.short_of("test_amplifier_triples_the_speed")
def test_amplifier_in_short():
    numbers = load_story("stokes/amplifier.py").main(0.25, 2)
    assert numbers["loss"] < numbers["first loss"]
    assert numbers["error of the gradient"] < 1e-5  # central differences, steps of 1e-5


@pytest.mark.slow
def test_amplifier_triples_the_speed(tmp_path):
    numbers = load_story("stokes/amplifier.py").main(0.5, 4, out=str(tmp_path), with_export=True)
    assert numbers["loss"] < 0.01 * numbers["first loss"]
    # the loss of a hundredth of a random design's, a few m^2/s^2, is a tenth of a meter per second
    assert numbers["outlet speed"] == pytest.approx(3.0, abs=0.1)
    assert numbers["outlet width"] == pytest.approx(0.25, abs=0.01)
    assert numbers["error of the gradient"] < 1e-5  # central differences, steps of 1e-5
    assert abs(numbers["mass imbalance"]) < 1e-3  # of 32 x 24 cells
    assert (tmp_path / "flow.png").stat().st_size > 10_000
    assert all((tmp_path / f"amplifier.{end}").exists() for end in ("stl", "vti", "rrd", "png"))
