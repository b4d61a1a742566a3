"""A tracker against videos whose discs were drawn where we know."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from diffsim.data.video import ColorBounds, TrackingError, track_video

cv2 = pytest.importorskip("cv2", reason="needs the extra video (OpenCV)")

Array = NDArray[np.float64]
YELLOW, SIZE, RATE, RADIUS = (60, 220, 200), (320, 180), 60.0, 12.0
_SHIFT = 8  # fractional bits of OpenCV's drawing


def film(path: Path, places: Array, *, noise: float = 3.0, hidden: set[int] = frozenset()) -> Path:
    """Discs at ``places`` (num_frames, num_balls, 2) [px] on a noisy grey table."""
    rng = np.random.default_rng(0)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, SIZE)
    for k, discs in enumerate(places):
        picture = np.full((SIZE[1], SIZE[0], 3), 120, np.uint8)
        for ball, place in enumerate(discs):
            if ball == 0 and k in hidden:
                continue
            fixed = tuple(round(float(c) * 2**_SHIFT) for c in place)
            radius = round(RADIUS * 2**_SHIFT)
            cv2.circle(picture, fixed, radius, YELLOW, -1, cv2.LINE_AA, _SHIFT)
        noisy = picture + rng.normal(0.0, noise, picture.shape)
        video.write(np.clip(noisy, 0, 255).astype(np.uint8))
    video.release()
    return path


def collision(gap: float) -> Array:
    """One disc rolls into another at rest and stops; they touch up to ``gap`` [px]."""
    k = np.arange(40)[:, None]
    distance = 2.0 * RADIUS + gap
    meet = 20
    moving = np.array([40.3, 90.2]) + np.minimum(k, meet) * np.array([5.0, 0.13])
    start = moving[meet] + np.array([distance, 0.0])
    struck = start + np.maximum(k - meet, 0) * np.array([4.5, -0.2])
    return np.stack([moving, struck], 1)


# JPEG stores colors at half the resolution: centers are off by up to half a pixel.
WORST, TYPICAL = 0.6, 0.25  # [px]


def test_centers_are_found_to_a_quarter_of_a_pixel(tmp_path: Path) -> None:
    truth = collision(gap=4.0)
    tracks = track_video(film(tmp_path / "a.avi", truth), 2)
    assert np.abs(tracks.centers - truth).max() < WORST
    assert np.sqrt(np.mean((tracks.centers - truth) ** 2)) < TYPICAL
    assert not tracks.merged.any()
    np.testing.assert_allclose(np.diff(tracks.time_s), 1.0 / RATE, rtol=1e-6)


def test_touching_discs_are_told_apart(tmp_path: Path) -> None:
    truth = collision(gap=-0.5)
    tracks = track_video(film(tmp_path / "a.avi", truth), 2)
    assert tracks.merged[20]
    assert not tracks.merged[:18].any()
    assert np.abs(tracks.centers - truth).max() < 1.5
    apart = ~tracks.merged
    assert np.abs(tracks.centers - truth)[apart].max() < WORST


def test_a_hidden_ball_is_missing_and_found_again(tmp_path: Path) -> None:
    truth = collision(gap=4.0)
    tracks = track_video(film(tmp_path / "a.avi", truth, hidden={8, 9}), 2)
    gone = np.isnan(tracks.centers[:, 0, 0])
    assert gone.nonzero()[0].tolist() == [8, 9]
    assert np.abs(tracks.centers[10:] - truth[10:]).max() < WORST


def test_paths_that_cross_keep_their_names(tmp_path: Path) -> None:
    k = np.arange(40.0)[:, None]
    down = np.array([60.0, 30.0]) + k * np.array([5.0, 3.0])
    up = np.array([64.0, 150.0]) + k * np.array([5.0, -3.0])
    # they pass the same height in different columns, and are nearest for a moment
    truth = np.stack([down, up + np.array([40.0, 0.0])], 1)
    tracks = track_video(film(tmp_path / "a.avi", truth), 2)
    assert np.abs(tracks.centers - truth).max() < WORST


def test_the_file_has_the_columns_of_the_data_set(tmp_path: Path) -> None:
    truth = collision(gap=4.0)[:12]
    tracks = track_video(film(tmp_path / "a.avi", truth, hidden={3}), 2, first=2)
    lines = tracks.save(tmp_path / "tracks.csv").read_text().splitlines()
    assert lines[0] == "frame,time_s,ball0_u_px,ball0_v_px,ball1_u_px,ball1_v_px"
    assert lines[1].startswith("2,0.000000,")
    assert lines[2].startswith("3,0.016667,,,")
    assert len(lines) == 11


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no video"):
        track_video(tmp_path / "none.avi", 2)
    path = tmp_path / "text.avi"
    path.write_text("not a video")
    with pytest.raises(TrackingError, match="no video that OpenCV"):
        track_video(path, 2)
    truth = collision(gap=4.0)[:5]
    with pytest.raises(TrackingError, match="expected 3 balls"):
        track_video(film(tmp_path / "a.avi", truth), 3)
    with pytest.raises(ValueError, match="hue"):
        ColorBounds((200, 0, 0), (179, 255, 255))
