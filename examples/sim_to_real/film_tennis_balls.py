"""A video of two colliding tennis balls whose truth is known, to test the way from video to fit.

The soft balls of tennis_balls.py, at numbers away from the fit's first guesses. Beside FILE.avi lie
FILE_corners.csv (eight points as if clicked) and FILE_truth.json. Running time: about 5 s.

    python examples/sim_to_real/film_tennis_balls.py runs/film.avi
    diffsim track runs/film.avi -o runs/film_tracks.csv
    python examples/sim_to_real/tennis_balls.py --quick --video runs/film.avi
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
from pathlib import Path

import numpy as np
import torch

from diffsim.core.files import write_json_atomic
from diffsim.data import Run, Study
from labs.balls import SoftBallModel
from labs.balls.film import film_balls, view_of
from labs.balls.fits import soft_model

RATE = 60.0  # frames per second
DIAMETER, MASS = 0.06858, 0.0577  # [m], [kg]
TRUTH = {
    **{"x0": 0.53, "y0": 0.29, "x1": 0.78, "y1": 0.295},  # [m]
    **{"vx1": -1.3, "vy1": 0.22, "wx1": -1.0, "wy1": 0.15},  # [m/s]
    **{"pair_stiffness": 2200.0, "ball_friction": 0.18, "table_friction": 0.3},  # [N/m], [-]
    "youngs_modulus": 3e5,  # [Pa]
    **{"focal": 1090.0, "turn_x": -0.04, "turn_y": 0.01},  # [px] at a width of 1280, [rad]
}
TABLE = ((0.0, 0.0, 0.0), (1.1, 0.0, 0.0), (1.1, 0.67, 0.0), (0.0, 0.67, 0.0))
BOX = ((0.0, 0.614), (0.245, 0.614), (0.245, 0.67), (0.0, 0.67))
CORNERS = (*TABLE, *((x, y, 0.245) for x, y in BOX))
TILT, EYE = 0.546, np.array([0.57, -0.45, 1.27])  # camera's axis from the vertical [rad], place [m]


def known_model(num_frames: int, size_px: tuple[int, int]) -> tuple[SoftBallModel, np.ndarray]:
    """The model, and its coordinates at ``TRUTH``."""
    c, s = np.cos(TILT), np.sin(TILT)
    rotation = np.array([[-1.0, 0.0, 0.0], [0.0, -c, -s], [0.0, -s, c]])
    focal = TRUTH["focal"] * size_px[0] / 1280.0
    tracks = np.full((num_frames, 6), np.nan)
    tracks[:, :4] = 0.0  # soft_model wants tracks for its first guess, which is not used
    corners = {f"corner_{a}_m": np.zeros(num_frames) for a in "xyz"}
    ball = {"ball_diameter_m": DIAMETER, "ball_mass_kg": MASS}
    run = Run("film", np.arange(num_frames) / RATE, tracks, corners, "film", setup=ball)
    camera = {"alpha_px": focal, "R": rotation.tolist(), "T_m": (-rotation @ EYE).tolist()}
    study = Study("film", "rigid_body", (), (run,), {"camera": camera, "size_px": list(size_px)})
    model = soft_model(study)
    truth = {**TRUTH, "focal": focal}
    x = [p.coordinate_of(truth[p.name]) if p.name in truth else 0.0 for p in model.base]
    return model, np.array(x)


def film(path: Path, num_frames: int = 33, size_px: tuple[int, int] = (1280, 720)) -> Path:
    """Write video, corners and truth."""
    model, x = known_model(num_frames, size_px)
    view = view_of(model, x)
    with torch.no_grad():
        centers = model.balls.centers(model.values_at(x), num_frames).numpy()
    film_balls(path, view, centers, model.balls.radius, table=np.array(TABLE), rate=RATE)
    rows = np.column_stack([view.project(np.array(CORNERS)), np.array(CORNERS)])
    head = "u_px,v_px,x_m,y_m,z_m"
    np.savetxt(path.with_name(f"{path.stem}_corners.csv"), rows, "%.8g", ",", "\n", head, "", "")
    values = {n: float(v) for n, v in model.values_at(x).items()}
    truth = {"values": values, "centers_px": view.project(centers)}
    write_json_atomic(path.with_name(f"{path.stem}_truth.json"), truth)
    return path


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
        parser.add_argument("file", type=Path, metavar="FILE.avi")
        parser.add_argument("--frames", type=int, default=33, help="default: %(default)s")
        parser.add_argument("--width", type=int, default=1280, help="[px], of 16:9")
        given = parser.parse_args()
        print(f"film: {film(given.file, given.frames, (given.width, given.width * 9 // 16))}")
