"""The story's own parts: frames joined, misfits judged, pictures, no recording."""

import numpy as np
import pytest
import torch

from diffsim.core.paths import data_folder
from diffsim.data import Run, Study
from labs.balls.figures import ShownBall, misfits, overlay, recording, simulated, strip
from labs.balls.recordings import ball_tracks_study
from tests.examples.stories import load_story

FOLDER = data_folder()
needs_data = pytest.mark.skipif(
    FOLDER is None or not (FOLDER / "tennis_balls/tracks.csv").is_file(), reason="no recording"
)


@pytest.fixture(scope="module")
def story():
    return load_story("sim_to_real/tennis_balls.py")


@needs_data
def test_all_frames_become_one_run(story):
    study = story.whole(ball_tracks_study(FOLDER / "tennis_balls"))
    (run,) = study.runs
    assert run.measured.shape == (33, 6)
    assert np.isfinite(run.measured[:, :4]).all()
    assert np.isfinite(run.measured[:, 4]).sum() == 8  # the corners
    assert bool((np.diff(run.time_s) > 0).all())
    assert len(run.command["corner_x_m"]) == 33


def test_distances_are_those_of_centers(story):
    measured = np.array([[0.0, 0.0, 10.0, 10.0, 5.0, 5.0], [0.0, 0.0, np.nan, np.nan, 5.0, 5.0]])
    run = Run("a", np.arange(2.0), measured, {}, "a")
    study = Study("s", "rigid_body", (), (run,))
    seen = np.nan_to_num(measured, nan=99.0) + np.array([3.0, 4.0, 3.0, 4.0, 0.0, 1.0])
    found = story.judge(study, lambda run: torch.from_numpy(seen))
    assert found == {"fitted_px": pytest.approx(5.0), "corners_px": pytest.approx(1.0)}


def test_says_that_there_is_no_recording(story, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path))
    assert story.main(["--out", str(tmp_path / "out")]) is None
    assert "DIFFSIM_DATA" in capsys.readouterr().out


def test_pictures_show_motion_and_misfit(tmp_path):
    model, x = load_story("sim_to_real/film_tennis_balls.py").known_model(5, (1280, 720))
    blank = np.zeros((5, 2, 2))
    truth = simulated("truth", model, x, blank).centers
    seen = truth + np.array([3.0, 4.0])
    seen[2, 1] = np.nan
    row = simulated("off", model, x, seen)
    assert row.title == "off: 5.0 px"
    middle = row.outlines.mean(2)  # of a sphere seen in perspective: nearly the center's image
    np.testing.assert_allclose(middle, row.centers, atol=1.0)
    rows, size = [row, ShownBall("tracked", None, seen)], (1280.0, 720.0)
    errors = misfits([row], seen, 7, 3)
    figures = (overlay(rows, seen, size, 3), strip(rows, seen, size, [0, 4], 7), errors)
    for k, figure in enumerate(figures):
        figure.savefig(tmp_path / f"{k}.png")
        assert (tmp_path / f"{k}.png").stat().st_size > 5000
    lines = errors.axes[0].lines
    np.testing.assert_allclose(lines[0].get_ydata(), 5.0)
    pytest.importorskip("rerun", reason="needs the extra viz (rerun-sdk)")
    assert recording(model, {"after": x}, 5, tmp_path / "balls.rrd").stat().st_size > 1000
