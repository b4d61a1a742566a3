"""Two tennis balls: does the story's simulator keep momentum and find its own parameters again?"""

import numpy as np
import pytest
import torch

from diffsim.core.paths import data_folder
from tests.examples.stories import load_story

pytestmark = pytest.mark.example
FOLDER = data_folder()


@pytest.fixture(scope="module")
def story():
    return load_story("contact/two_tennis_balls.py")


@pytest.fixture(scope="module")
def impact(story):
    """Known parameters from frame 157 to 162; the balls touch between 159 and 161."""
    balls = story.Balls(0.033, 0.018, 16)
    with torch.no_grad():
        return balls, balls.simulate(torch.tensor(story.KNOWN, dtype=torch.float64), 6)


def test_only_table_and_weight_change_the_momentum_of_the_pair(story, impact):
    _, motion = impact
    assert motion.reciprocity < 1e-10  # [N], of some 20 N: rounding
    change = (motion.velocity[-1] - motion.velocity[0]).sum(0)
    gravity = torch.tensor([0.0, 0.0, -2 * story.GRAVITY * 5 * story.FRAME], dtype=torch.float64)
    left = change - motion.table_impulse[-1] / story.MASS - gravity
    assert float(left.abs().max()) < 1e-5  # [m/s], of 0.7: 1e-7 measured, the solver's tolerance
    assert float(motion.velocity[-1, 0, 0]) < -0.4  # and there was an impact


def test_energy_falls(impact):
    _, motion = impact
    assert motion.energy[-1] < motion.energy[0]


def test_masses_are_those_of_a_balanced_hollow_ball(story, impact):
    balls, _ = impact
    x, m = balls.mesh.x_rest, balls.mass
    assert float(m.min()) > 0
    assert float(m.sum()) == pytest.approx(story.MASS)
    second = torch.einsum("n,ni,nj->ij", m, x, x)
    expected = 0.5 * story.INERTIA * story.MASS * 0.033**2 * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(second, expected, rtol=1e-9, atol=1e-12)


def test_finds_its_own_parameters_again(story):
    numbers = story.main(last=163, steps=16, max_evals=5, synthetic=True)
    assert numbers["cost"] < 0.7 * numbers["start_cost"]  # eight evaluations reach 5 %


def test_says_that_there_is_no_recording(story, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path))
    assert story.main() is None
    assert "DIFFSIM_DATA" in capsys.readouterr().out


@pytest.mark.skipif(
    FOLDER is None or not (FOLDER / "tennis_balls/tracks.csv").is_file(), reason="no recording"
)
def test_camera_and_rigid_fit_reproduce_the_tracks(story):
    video = story.load()
    np.testing.assert_allclose(
        video.camera.table(video.pixels, video.height), video.metres, atol=2e-5
    )  # the published places carry five decimals
    places, start, diameter = story.rigid_start(video, 170, 0)
    pixels = video.camera.pixels(torch.from_numpy(places)).numpy()
    errors = story.Errors.of(video, pixels, 150, 170)
    assert errors.pixels[0] < 1.5  # 0.8 px measured
    assert 0.06 < diameter < 0.072
    assert start.shape == (len(story.NAMES),)
