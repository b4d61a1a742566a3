"""Do the stories end as told?"""

import pytest

from diffsim import mesh
from tests.examples.stories import load_story

pytestmark = pytest.mark.example


def test_muscle_arm_reaches_its_target(tmp_path):
    picture = tmp_path / "arm.png"
    numbers = load_story("softbody/muscle_arm.py").main(cells=3, plot=str(picture))
    assert numbers["start_mm"] > 50.0
    assert numbers["static_mm"] < 0.1  # the two claims of the story's docstring
    assert numbers["after_3_s_mm"] < 1.0
    assert picture.stat().st_size > 10_000


@pytest.mark.short_of("test_swimmer_learns_to_swim")
def test_swimmer_learns_in_short():
    numbers = load_story("softbody/swimmer.py").main(iterations=1, periods=2)
    assert numbers["after_mm_per_s"] > numbers["before_mm_per_s"]


@pytest.mark.slow
def test_swimmer_learns_to_swim(tmp_path):
    """Three iterations on two periods instead of eight on three: 4.1 mm/s from -0.1 mm/s."""
    picture = tmp_path / "swimmer.png"
    numbers = load_story("softbody/swimmer.py").main(iterations=3, periods=2, plot=str(picture))
    assert abs(numbers["before_mm_per_s"]) < 1.0
    assert numbers["after_mm_per_s"] > 3.0
    assert picture.stat().st_size > 10_000


def test_twisting_armadillo_ends_alike_by_both_solvers(tmp_path):
    picture = tmp_path / "armadillo.png"
    module = load_story("softbody/twisting_armadillo.py")
    numbers = module.main(
        **{**module.SMALL, "frames": 3},
        rtol=1e-8,
        methods=("auto", "newton_cholesky"),
        plot=str(picture),
    )
    assert numbers["num_dof"] > 1000
    assert numbers["newton_cholesky.largest_difference_mm"] < 1e-3
    for name in ("hand_mm", "hand_per_degree_mm", "hand_per_modulus_mm"):
        auto, direct = numbers[f"auto.{name}"], numbers[f"newton_cholesky.{name}"]
        assert abs(auto - direct) < 1e-5 * (1e-3 + abs(direct))
    assert picture.stat().st_size > 10_000


def test_twisting_armadillo_takes_a_users_mesh(tmp_path):
    module = load_story("softbody/twisting_armadillo.py")
    file = tmp_path / "body.msh"
    mesh.save(module.make_mesh(0.06, None), file)
    numbers = module.main(file=str(file), frames=1, degrees=90.0)
    assert numbers["num_dof"] > 300
    assert abs(numbers["auto.hand_mm"]) > 50.0
