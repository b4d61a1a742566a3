"""One short film of two balls for all tests here."""

from pathlib import Path

import pytest

from tests.examples.stories import load_story

NUM_FRAMES = 20


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of 640 x 360 pixels; corners and truth lie beside it. The balls meet in frame 11."""
    pytest.importorskip("cv2", reason="needs the extra video (OpenCV)")
    story = load_story("sim_to_real/film_tennis_balls.py")
    return story.film(tmp_path_factory.mktemp("film") / "film.avi", NUM_FRAMES, (640, 360))
