"""A film of the simulation, its tracks, and ``diffsim track``."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from diffsim import cli
from diffsim.data import load_study
from diffsim.data.video import Tracks, noise_px, track_video, tracks_study, without_merged

WORST_APART, TYPICAL_APART, WORST_TOUCHING = 0.6, 0.25, 1.5  # [px], as in tests/data/test_video.py


def truth_of(film: Path) -> dict:
    return json.loads(film.with_name("film_truth.json").read_text())


def test_tracks_of_the_film_are_where_the_balls_were(film):
    tracks = track_video(film, 2)
    off = np.abs(tracks.centers - np.array(truth_of(film)["centers_px"]))
    assert 1 <= tracks.merged.sum() <= 4  # the balls touch and part again
    assert off[~tracks.merged].max() < WORST_APART
    assert np.sqrt((off[~tracks.merged] ** 2).mean()) < TYPICAL_APART
    assert off.max() < WORST_TOUCHING


def test_a_ball_hidden_while_it_rolls_is_found_again(tmp_path, film):
    from labs.balls.film import film_balls, view_of
    from tests.examples.stories import load_story

    story = load_story("sim_to_real/film_tennis_balls.py")
    model, x = story.known_model(8, (640, 360))
    centers = model.balls.centers(model.values_at(x), 8).detach().numpy()
    path = film_balls(
        tmp_path / "hidden.avi",
        view_of(model, x),
        centers,
        model.balls.radius,
        table=np.array(story.TABLE),
        hidden=[(4, 1), (5, 1)],
    )
    tracks = track_video(path, 2)
    assert np.isnan(tracks.centers[:, 1, 0]).nonzero()[0].tolist() == [4, 5]
    seen = view_of(model, x).project(centers)
    assert np.abs(tracks.centers[6:] - seen[6:]).max() < WORST_APART


def test_command_writes_a_table(film, tmp_path, capsys):
    path = tmp_path / "tracks.csv"
    assert cli.main(["track", str(film), "-o", str(path), "--last", "15"]) == 0
    rows = path.read_text().splitlines()
    assert rows[0] == "frame,time_s,ball0_u_px,ball0_v_px,ball1_u_px,ball1_v_px"
    assert len(rows) == 17
    assert "16 frames, balls touch in" in capsys.readouterr().out


def test_command_writes_a_study_without_touching_balls(film, tmp_path):
    assert cli.main(["track", str(film), "-o", str(tmp_path / "film"), "--drop-merged"]) == 0
    study = load_study(tmp_path / "film")
    (run,) = study.runs
    touching = study.metadata["frames_in_which_balls_touch"]
    assert [c.name for c in study.channels][:2] == ["ball0_u_px", "ball0_v_px"]
    assert np.isnan(run.measured[touching]).all()
    assert np.isfinite(run.measured).all(1).sum() == len(run.time_s) - len(touching)
    assert all(0.0 < c.sd < 1.0 for c in study.channels)


@pytest.mark.parametrize(
    ("content", "words"), [(None, "no video"), ("text", "no video that OpenCV can read")]
)
def test_command_says_what_is_wrong_with_the_file(content, words, tmp_path, capsys):
    pytest.importorskip("cv2", reason="needs the extra video (OpenCV)")
    path = tmp_path / "film.avi"
    if content is not None:
        path.write_text(content)
    assert cli.main(["track", str(path), "-o", str(tmp_path / "t.csv")]) == cli.EXIT_MISTAKE
    assert words in capsys.readouterr().err
    assert not (tmp_path / "t.csv").exists()


def test_command_says_how_to_get_opencv(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert cli.main(["track", str(tmp_path / "a.avi"), "-o", "t.csv"]) == cli.EXIT_MISTAKE
    assert "pip install 'opencv-python-headless>=" in capsys.readouterr().err


def made(centers: np.ndarray) -> Tracks:
    frames = np.arange(len(centers))
    return Tracks(frames, frames / 60.0, centers, np.zeros(len(centers), dtype=bool))


def test_noise_of_a_smooth_track_is_found():
    rng = np.random.default_rng(0)
    time = np.arange(400.0)
    path = np.stack([time, 0.002 * time**2], -1)[:, None]
    tracks = made(path + rng.normal(0.0, [0.2, 0.5], path.shape))
    np.testing.assert_allclose(noise_px(tracks), [[0.2, 0.5]], rtol=0.2)


def test_too_few_frames_leave_the_noise_unknown():
    study = tracks_study(made(np.zeros((3, 2, 2))), "short")
    assert [c.sd for c in study.channels] == [None] * 4


def test_frames_in_which_balls_touch_become_missing():
    tracks = made(np.ones((4, 2, 2)))
    tracks.merged[2] = True
    left = without_merged(tracks).centers
    assert np.isnan(left[2]).all() and np.isfinite(np.delete(left, 2, 0)).all()
