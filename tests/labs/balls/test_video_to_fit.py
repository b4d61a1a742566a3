"""From a film to tracks to the soft balls' parameters."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from diffsim.data.calibration import calibrate
from labs.balls.fits import soft_model
from labs.balls.recordings import ball_video_study
from labs.balls.soft import MOTION
from tests.examples.stories import load_story

DIAMETER, MASS = 0.06858, 0.0577


@pytest.fixture(scope="module")
def study(film):
    corners = film.with_name("film_corners.csv")
    return ball_video_study(film, corners, diameter_m=DIAMETER, mass_kg=MASS, held_out=0.2)


def truth_of(film: Path) -> dict[str, float]:
    return json.loads(film.with_name("film_truth.json").read_text())["values"]


def test_study_has_the_layout_of_the_published_one(study):
    fitted, judged = study.runs
    assert (fitted.use, judged.use) == ("fit", "test")
    assert len(fitted.time_s) == 16 and len(judged.time_s) == 4
    assert np.isfinite(fitted.measured[:8, 4:]).all() and np.isnan(fitted.measured[8:, 4:]).all()
    assert np.isnan(fitted.measured[:, :4]).any(1).sum() >= 1  # the balls touch


def test_camera_is_calibrated_from_the_clicks(study, film):
    assert study.metadata["camera"]["alpha_px"] == pytest.approx(truth_of(film)["focal"], rel=1e-4)
    assert study.metadata["camera"]["reprojection_rms_px"] < 1e-3


def test_truth_predicts_the_tracks_and_first_guess_is_near(study, film):
    """The whole way: simulation, film, tracker, calibration, and the same simulation again."""
    model = soft_model(study)
    truth = truth_of(film)
    center = {p.name: p.value for p in model.base}
    for name in ("x0", "y0", "x1", "y1"):
        assert center[name] == pytest.approx(truth[name], abs=0.002)  # [m]
    assert center["vx1"] == pytest.approx(truth["vx1"], abs=0.1)  # [m/s], a parabola's
    x = [p.coordinate_of(truth[p.name]) if p.name in MOTION else 0.0 for p in model.base]
    run = study.fit_runs[0]
    with torch.no_grad():
        seen = model.predict(run, torch.tensor(x, dtype=torch.float64)).numpy()
    off = (seen - run.measured)[:, :4]
    assert np.nanmax(np.abs(off)) < 1.0
    assert np.sqrt(np.nanmean(off**2)) < 0.4


@pytest.mark.slow
def test_story_finds_the_throw_of_a_film(tmp_path):
    """Places and velocity are found again; spin and contact hide in the facets' roughness."""
    pytest.importorskip("cv2", reason="needs the extra video (OpenCV)")
    pytest.importorskip("rerun", reason="needs the extra viz (rerun-sdk)")
    film = load_story("sim_to_real/film_tennis_balls.py").film(tmp_path / "film.avi")
    story = load_story("sim_to_real/tennis_balls.py")
    out = tmp_path / "out"
    result = story.main(["--quick", "--video", str(film), "--out", str(out)])
    assert result["after"]["fitted_px"] < 0.8 * result["before"]["fitted_px"]
    off = {n: abs(a - b) for n, (a, b) in result["found_and_true"].items()}
    assert max(off[n] for n in ("x0", "y0", "x1", "y1")) < 0.001  # [m]
    assert max(off["vx1"], off["vy1"]) < 0.05  # [m/s], of 1.3
    for name in ("result.json", "rounds.json", "overlay.png", "strip.png", "errors.png"):
        assert (out / name).stat().st_size > 0


def test_too_short_a_film_is_refused(film):
    corners = film.with_name("film_corners.csv")
    with pytest.raises(ValueError, match="expected at least 10"):
        ball_video_study(film, corners, diameter_m=DIAMETER, mass_kg=MASS, last=8)


def test_points_in_one_plane_are_refused():
    pytest.importorskip("cv2", reason="needs the extra video (OpenCV)")
    flat = np.array([[x, y, 0.0] for x in (0.0, 0.5, 1.0) for y in (0.0, 0.6)])
    with pytest.raises(ValueError, match="in one plane"):
        calibrate(flat, flat[:, :2], (640, 360))
    with pytest.raises(ValueError, match="n >= 6"):
        calibrate(flat[:4], flat[:4, :2], (640, 360))
