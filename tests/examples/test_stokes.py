"""Do the stories of slow flow end as told? Each runs at its small size."""

import importlib.util
from pathlib import Path

import pytest

pytestmark = pytest.mark.example
STOKES = Path(__file__).resolve().parents[2] / "examples/stokes"


def load(name):
    spec = importlib.util.spec_from_file_location(name, STOKES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_amplifier_triples_the_speed(tmp_path):
    numbers = load("amplifier").main(0.5, 4, out=str(tmp_path), with_export=True)
    assert numbers["loss"] < 0.01 * numbers["first loss"]
    # the loss of a hundredth of a random design's, a few m^2/s^2, is a tenth of a metre per second
    assert numbers["outlet speed"] == pytest.approx(3.0, abs=0.1)
    assert numbers["outlet width"] == pytest.approx(0.25, abs=0.01)
    assert numbers["error of the gradient"] < 1e-5  # central differences, steps of 1e-5
    assert abs(numbers["mass imbalance"]) < 1e-3  # of 32 x 24 cells
    assert (tmp_path / "flow.png").stat().st_size > 10_000
    assert all((tmp_path / f"amplifier.{end}").exists() for end in ("stl", "vti", "rrd", "png"))
