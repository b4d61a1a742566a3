"""The robot fish: a camera that counts its own seconds, on a twin and on the recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from diffsim.data import load_study
from diffsim.data.study import Run
from diffsim.systems import published
from diffsim.systems.registry import setup_of
from tests.measured import data_folder
from tests.systems.published.fits import fitted

pytestmark = pytest.mark.reference
FILE = Path(published.__file__).parent / "robot_fish.yaml"
FAST = 0.05  # share by which the twin's camera is fast
PACE_CAUSES = ("clock_rate", "slow_motor")


def markers_of(read: np.ndarray) -> np.ndarray:
    """Tracks (num_samples, 9, 2) that show these readings; what no channel shows lies on the head.

    Args:
        read: (num_samples, 8) middle of the head, heading, tail5 to tail8, length8.
    """
    middle, heading = read[:, :2], read[:, 2]
    along = np.stack([np.cos(heading), np.sin(heading)], -1)
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    tracks = np.repeat(middle[:, None], 9, 1)
    tracks[:, 0] -= 0.071 * along
    tracks[:, 1] += 0.071 * along
    for marker, x in ((5, 0.36), (6, 0.39), (7, 0.41), (8, read[:, 7:])):
        tracks[:, marker] += x * along + read[:, marker - 2, None] * across
    return tracks


def write_twin(folder: Path, fast: float, seconds: float = 4.0) -> Path:
    """Two recordings in the authors' format, of a fish that the description makes; the study."""
    stated = yaml.safe_load(FILE.read_text())
    del stated["data"]
    stated["runs"] = stated["runs"][:2]
    time_s = np.arange(0.0, seconds, 1.0 / 60.0)
    header = [f"marker{k}_{axis}_m" for k in range(9) for axis in "xy"]
    rng = np.random.default_rng(5)
    for run in stated["runs"]:
        blank = np.column_stack([time_s, markers_of(np.zeros((len(time_s), 8))).reshape(-1, 18)])
        np.savetxt(
            folder / run["file"],
            blank,
            delimiter=",",
            header=",".join(["time_s", *header]),
            comments="",
        )
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(stated, sort_keys=False))
    for entry, plan in zip(stated["runs"], load_study(path).runs, strict=True):
        hidden = {**stated["model"], "parameters": {**stated["model"]["parameters"]}}
        hidden["parameters"]["pace"] = 1.0 / (1.0 + fast)
        study = replace(load_study(path), model=hidden)
        model = setup_of(study).model
        whole = Run(plan.name, time_s, np.zeros((len(time_s), 8)), {}, plan.name, setup=plan.setup)
        read = model.predict(whole, model.at_prior()).detach().numpy()
        tracks = markers_of(read) + 0.0006 * rng.normal(size=(len(time_s), 9, 2))
        table = np.column_stack([time_s, tracks.reshape(-1, 18)])
        np.savetxt(
            folder / entry["file"],
            table,
            delimiter=",",
            header=",".join(["time_s", *header]),
            comments="",
            fmt="%.5f",
        )
    return path


def test_a_fast_camera_is_seen_with_its_size_and_looks_like_a_slow_motor(tmp_path):
    study = load_study(write_twin(tmp_path, FAST))
    plain = fitted(study)
    found = {name: fitted(study, name) for name in PACE_CAUSES}
    for name in PACE_CAUSES:
        assert found[name].values[name] == pytest.approx(1.0 / (1.0 + FAST) - 1.0, abs=0.003)
        assert found[name].chi2 < 0.2 * plain.chi2
    chi2 = [f.chi2 for f in found.values()]
    assert abs(chi2[0] - chi2[1]) < 4.0  # nobody can tell them apart by tracks alone


@pytest.mark.cpu(15)  # two fits of the two recordings
def test_the_recorded_fish_beats_three_quarters_as_often_as_stated():
    data_folder("robot_fish")
    stated = load_study(FILE)
    chi2 = []
    for key in ("drive_ratio", "pace"):
        model = {**stated.model, "parameters": {**stated.model["parameters"], key: 0.75}}
        study = replace(stated, model=model)
        found = fitted(study, *PACE_CAUSES[:1])
        assert found.values["clock_rate"] == pytest.approx(0.0, abs=0.006)
        chi2.append(found.chi2)
    assert chi2[0] == pytest.approx(chi2[1], rel=0.01)


def test_momentum_is_kept_where_the_water_only_has_inertia(tmp_path):
    """Without drag and wake the tail may beat as it likes: the fish's momenta stay."""
    path = write_twin(tmp_path, 0.0, seconds=1.0)
    stated = yaml.safe_load(path.read_text())
    numbers = stated["model"]["parameters"]
    numbers |= dict.fromkeys(("wake", "body_drag", "tail_drag", "fin_drag", "drag_area"), 0)
    momenta = {"head_x": "px", "head_y": "py", "heading": "x*py - y*px + pturn"}
    stated["model"]["readings"] |= momenta
    path.write_text(yaml.safe_dump(stated, sort_keys=False))
    study = load_study(path)
    model = setup_of(study).model
    with torch.no_grad():
        read = model.predict(study.runs[0], model.at_prior()).numpy()[:, :3]
    assert np.abs(read[0, :2]).max() > 0.1
    assert np.ptp(read, 0) == pytest.approx(np.zeros(3), abs=2e-6)
