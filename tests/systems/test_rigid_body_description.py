"""Rigid bodies described in a study: mistakes in terms of keys, hidden effects, nothing hidden."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from diffsim import cli
from diffsim.data import save_study
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.identify import fit
from diffsim.systems.registry import description_of, setup_of
from diffsim.systems.rigid_body.figure import figure_of
from diffsim.systems.rigid_body.layout import PoseLayout

RADIUS, GRAVITY = 0.02, 9.81
POSITIONS = ("x", "y", "z")


def throw(rng, *, drag=0.0, slope=0.0, restitution=0.9, seconds=1.2):
    """A ball's track, (times, (num_samples, 3)) [s, m], from impact to impact by DOP853."""

    def fall(t, y):
        v = y[3:]
        return np.concatenate([v, [0.0, 0.0, -GRAVITY] - drag * np.linalg.norm(v) * v])

    def gap(t, y):
        return y[2] - RADIUS

    gap.terminal, gap.direction = True, -1
    time = np.arange(0.0, seconds, 1.0 / 120.0)
    out, begin = np.full((len(time), 3), np.nan), 0.0
    state = np.array([*rng.uniform(-0.5, 0.5, 2), 0.8, *rng.uniform(-2.0, 2.0, 2), 1.0])
    while begin < seconds:
        part = solve_ivp(
            fall, (begin, seconds + 1.0), state, events=gap, dense_output=True, rtol=1e-9
        )
        end = part.t_events[0][0]
        inside = (time >= begin) & (time <= end)
        if inside.any():
            out[inside] = part.sol(time[inside])[:3].T
        state = part.y_events[0][0].copy()
        speed = -state[5]
        state[5] = restitution * np.exp(slope * (speed - 1.0)) * speed
        begin = end
    return time, out + rng.normal(0.0, 5e-4, out.shape)


def bouncing(seed=0, up="z", **hidden):
    """Six throws, two of them unseen; frictionless, so that no spin begins."""
    rng = np.random.default_rng(seed)
    runs = []
    for i, use in enumerate(("fit", "fit", "fit", "select", "test", "test")):
        time, place = throw(rng, **hidden)
        if up == "y":
            place = np.column_stack([place[:, 0], place[:, 2], -place[:, 1]])
        runs.append(Run(f"throw_{i}", time, place, {}, f"throw_{i}", i, use))
    model = {
        "system": "rigid_body",
        "up": up,
        "bodies": [{"name": "ball", "sphere": "40 mm", "mass": "2.7 g", "inertia_ratio": 0.667}],
        "contacts": [
            {
                "between": ["ball", "ground"],
                "restitution": {"value": 0.85, "sd": 0.1, "upper": 1},
                "friction": 0.0,
            }
        ],
        "measures": [{"body": "ball", "position": {a: a for a in POSITIONS}}],
    }
    channels = tuple(Channel(a, "m", "position", 5e-4) for a in POSITIONS)
    return Study("balls", "rigid_body", channels, tuple(runs), model=model)


def judged(study):
    s = setup_of(study)
    return diagnose(s.study or study, s.model, s.effects, seed=0, settings=s.settings)


def test_hidden_drag_is_named():
    report = judged(bouncing(up="y", drag=0.13))
    assert report.named == ("air_drag",)
    assert report.best.values["air_drag"] == pytest.approx(0.13, rel=0.1)
    assert report.gain is not None and report.gain.low > 0.9


@pytest.mark.story  # a further cause of the kind
def test_hidden_fall_of_restitution_is_named():
    report = judged(bouncing(seed=1, slope=-0.06))
    assert report.named == ("restitution_slope",)
    assert report.best.values["restitution_slope"] == pytest.approx(-0.06, rel=0.1)


def test_nothing_hidden_nothing_named():
    report = judged(bouncing(seed=2))
    assert report.verdict == "none"
    assert report.named == ()


def test_typical_drag_is_that_of_the_ball():
    """Half of air's density times half of the shadow, over the mass: 0.14 1/m."""
    effects = {e.name: e for e in setup_of(bouncing()).effects}
    shadow = 0.25 * np.pi * 0.04**2
    assert effects["air_drag"].typical == pytest.approx(0.5 * 1.2 * 0.5 * shadow / 0.0027)


def test_channels_that_nothing_shows_are_told():
    study = bouncing()
    position = {"x": "x", "y": "why", "z": "z"}
    model = {**study.model, "measures": [{"body": "ball", "position": position}]}
    found = description_of(replace(study, model=model)).problems(study)
    assert [p.where for p in found] == ["model.measures", "channel y"]


# A tossed box ------------------------------------------------------------------------------------

EDGES = np.array([0.12, 0.08, 0.05])


def toss(rng, i, use, gravity=9.81, scale=1.0):
    """Free flight of a box by Euler's equations, and two dozen frames at rest."""
    moments = (np.sum(EDGES**2) - EDGES**2) / 12.0

    def slope(t, y):
        q, w = y[6:10], y[10:]
        turn = 0.5 * np.concatenate([np.cross(q[:3], w) + q[3] * w, [-q[:3] @ w]])
        return np.concatenate([y[3:6], [0, 0, -gravity], turn, np.cross(moments * w, w) / moments])

    start = [*rng.uniform(-0.3, 0.3, 2), 0.6, *rng.uniform(-1, 1, 2), 1.0]
    start += [*Rotation.random(random_state=rng).as_quat(), *rng.normal(0.0, 4.0, 3)]
    time = np.arange(0.0, 0.4, 1.0 / 100.0)
    y = solve_ivp(slope, (0, 1), start, t_eval=time, rtol=1e-10, atol=1e-12).y
    place = scale * y[:3].T + rng.normal(0.0, 1e-4, (len(time), 3))
    q = y[6:10].T / np.linalg.norm(y[6:10].T, axis=1, keepdims=True)
    turn = q[:, [3, 0, 1, 2]] + rng.normal(0.0, 2e-4, (len(time), 4))
    turn[11] *= -1.0  # a tracker may jump between the two quaternions of a turn
    at_rest = np.tile([0.3, 0.2, scale * 0.5 * EDGES[2], 1.0, 0.0, 0.0, 0.0], (24, 1))
    at_rest[:, :3] += rng.normal(0.0, 1e-4, (24, 3))
    measured = np.vstack([np.column_stack([place, turn]), at_rest])
    measured[7] = np.nan  # a frame that was not tracked
    clock = np.arange(len(measured)) / 100.0
    return Run(f"toss_{i}", clock, measured, {}, f"toss_{i}", i, use)


@lru_cache
def box_study(scale=1.0):
    rng = np.random.default_rng(4)
    uses = ("fit",) * 6 + ("select",) * 2 + ("test",) * 2
    runs = tuple(toss(rng, i, use, scale=scale) for i, use in enumerate(uses))
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    units = ("m",) * 3 + ("-",) * 4
    sds = (1e-4,) * 3 + (2e-4,) * 4
    channels = tuple(Channel(n, u, "pose", s) for n, u, s in zip(names, units, sds, strict=True))
    model = {
        "system": "rigid_body",
        "bodies": [{"name": "box", "box": ["120 mm", "80 mm", "50 mm"], "mass": "0.4 kg"}],
        "contacts": [{"between": ["box", "ground"]}],
        "window": {"until": "touch", "rest_frames": 20, "rest_sd": "0.05 mm"},
        "measures": [
            {"body": "box", "position": {"x": "x", "y": "y", "z": "z"}},
            {"body": "box", "quaternion": ["qw", "qx", "qy", "qz"]},
        ],
    }
    return Study("box", "rigid_body", channels, runs, model=model)


def test_a_box_of_unequal_edges_flies_as_euler_says():
    s = setup_of(box_study())
    found = fit(s.model, s.study.fit_runs, s.study.channels)
    assert found.chi2 / found.num_samples == pytest.approx(1.0, abs=0.15)


@pytest.mark.story  # a further cause of the kind
def test_lengths_are_named_and_gravity_is_not():
    """Two per cent in all lengths look like two per cent less gravity, but for the rest."""
    study = box_study(scale=0.98)
    only = ["length_scale", "weaker_gravity", "clock_scale", "ground_height", "half_width"]
    report = judged(replace(study, model={**study.model, "effects": {"only": only}}))
    assert report.named == ("length_scale",)
    assert report.best.values["length_scale"] == pytest.approx(-0.02, abs=0.001)
    status = {c.name: c.status for c in report.causes}["weaker_gravity"]
    assert status in ("refuted", "not visible below")


def test_the_window_ends_before_the_touch():
    study = box_study()
    cut = setup_of(study).study
    assert all(len(r.time_s) <= 40 for r in cut.runs)
    assert [c.name for c in cut.channels][-1] == "rest_height_m"
    rest = np.array([r.measured[-1, -1] for r in cut.runs])
    np.testing.assert_allclose(rest, 0.025, atol=1e-4)


def test_a_toss_too_short_to_count_is_told(tmp_path, capsys):
    """It was left out without a word, of test runs too."""
    study = box_study()
    short = study.runs[3]
    short = replace(short, time_s=short.time_s[:9], measured=short.measured[:9])
    study = replace(study, runs=(*study.runs[:3], short, *study.runs[4:]))
    cut = setup_of(study).study
    assert len(cut.runs) == len(study.runs) - 1
    (told,) = cut.left_out
    assert told == "run toss_3: its window has fewer than 10 frames of flight"
    assert cli.main(["diagnose", "check", str(save_study(study, tmp_path))]) == 0
    assert f"not used: {told}" in capsys.readouterr().out


def test_angles_are_as_good_as_quaternions():
    study = box_study()
    rpy = [
        Rotation.from_quat(np.nan_to_num(r.measured[:, [4, 5, 6, 3]], nan=1.0))
        .as_euler("ZYX")[:, ::-1]
        .copy()
        for r in study.runs
    ]
    for angles in rpy:
        angles[7] = np.nan
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    channels = tuple(Channel(n, "m", "pose", 1e-4 if n in "xyz" else 4e-4) for n in names)
    runs = tuple(
        replace(r, measured=np.column_stack([r.measured[:, :3], a]))
        for r, a in zip(study.runs, rpy, strict=True)
    )
    measures = [
        {"body": "box", "position": {"x": "x", "y": "y", "z": "z"}},
        {"body": "box", "angles": {n: n for n in names[3:]}},
    ]
    model = {**study.model, "measures": measures}
    s = setup_of(replace(study, channels=channels, runs=runs, model=model))
    run = s.study.runs[0]
    with torch.no_grad():
        seen = s.model.predict(run, s.model.at_prior()).numpy()
    off = (seen - run.measured)[:, 3:6]
    assert np.nanmax(np.abs(off)) < 0.02


# A rolling ball ----------------------------------------------------------------------------------

CAMERA_AT, FOCAL = np.array([0.5, -0.6, 1.2]), 1000.0


def seen_from(place):
    """Pixels (u right, v down) of a camera that looks down at the table's middle, 1280 x 720."""
    ahead = np.array([0.5, 0.3, 0.0]) - CAMERA_AT
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.array([-right, np.cross(ahead, right), -ahead])  # Y2 is below 0 in front
    y = (place - CAMERA_AT) @ axes.T
    pixels = np.column_stack([640 + FOCAL * y[:, 0] / y[:, 2], 360 - FOCAL * y[:, 1] / y[:, 2]])
    return pixels, axes, -axes @ CAMERA_AT


def rolling_place(resistance, velocity, seconds=0.9):
    time = np.arange(0.0, seconds, 1.0 / 60.0)
    speed = np.linalg.norm(velocity)
    gone = speed * time - 0.5 * resistance * GRAVITY * time**2
    place = np.array([0.1, 0.1, RADIUS]) + gone[:, None] * np.array([*velocity, 0.0]) / speed
    return time, place


def rolling_study(folder, resistance):
    """Four balls that roll through a camera's picture; eight points are clicked."""
    rng = np.random.default_rng(5)
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 0.6) for z in (0.0, 0.2)])
    clicks, axes, shift = seen_from(corners)
    table = np.column_stack([clicks + rng.normal(0.0, 0.5, clicks.shape), corners])
    np.savetxt(
        folder / "points.csv", table, delimiter=",", header="u,v,x,y,z", comments="", fmt="%.5f"
    )
    runs = []
    for i, (use, velocity) in enumerate(
        (("fit", (1.0, 0.2)), ("fit", (0.6, 0.4)), ("select", (0.8, 0.3)), ("test", (0.7, 0.5)))
    ):
        time, place = rolling_place(resistance, np.array(velocity))
        pixels = seen_from(place)[0] + rng.normal(0.0, 0.3, (len(time), 2))
        runs.append(Run(f"roll_{i}", time, pixels, {}, f"roll_{i}", i, use))
    model = {
        "system": "rigid_body",
        "bodies": [{"name": "ball", "sphere": "40 mm", "begins": "on_ground"}],
        "camera": {
            "size": [1280, 720],
            "focal": {"value": 1050.0, "percent": 10},
            "rotation": axes.tolist(),
            "shift": [{"value": float(s), "sd": 0.05} for s in shift],
            "points": {"file": "points.csv", "columns": ["u", "v", "x", "y", "z"], "sd": 0.5},
        },
        "measures": [{"body": "ball", "pixels": ["u", "v"]}],
    }
    channels = tuple(Channel(n, "px", "image", 0.3) for n in "uv")
    return Study("rolling", "rigid_body", channels, tuple(runs), model=model, folder=folder)


def test_rolling_resistance_is_seen_through_a_camera(tmp_path):
    report = judged(rolling_study(tmp_path, 0.02))
    assert report.named == ("rolling_resistance",)
    assert report.best.values["rolling_resistance"] == pytest.approx(0.02, rel=0.1)
    assert report.best.values["focal"] == pytest.approx(FOCAL, rel=0.01)


def test_a_part_of_the_clicked_points_may_be_left_out(tmp_path):
    """Growing windows cut every run, that of the clicked points, too."""
    setup = setup_of(rolling_study(tmp_path, 0.0))
    clicks = next(r for r in setup.study.runs if r.name == "calibration_points")
    part = slice(2, 5)
    few = replace(clicks, time_s=clicks.time_s[part], measured=clicks.measured[part])
    full, seen = (setup.model.predict(r, setup.model.at_prior()) for r in (clicks, few))
    assert torch.equal(seen, full[part])


def test_missing_points_are_told_and_a_stated_camera_does_without(tmp_path):
    study = rolling_study(tmp_path, 0.0)
    (tmp_path / "points.csv").unlink()
    (found,) = description_of(study).problems(study)
    assert (found.severity, found.where) == ("warning", "model.camera.points.file")
    assert "calibration_points" not in [r.name for r in (setup_of(study).study or study).runs]
    camera = {k: v for k, v in study.model["camera"].items() if k != "focal"}
    less = replace(study, model={**study.model, "camera": camera})
    with pytest.raises(ValueError, match="nothing else finds it"):
        setup_of(less)


def test_a_ball_that_rolls_freely_says_nothing(tmp_path):
    report = judged(rolling_study(tmp_path, 0.0))
    assert report.named == ()


def test_the_box_that_pages_show_stands_as_its_channels_say():
    rng = np.random.default_rng(0)
    turns = Rotation.random(5, random_state=0)
    place, edges = rng.normal(size=(5, 3)), torch.tensor([0.1, 0.2, 0.3]).double()
    rows = [*(("position", k) for k in range(3)), *(("quaternion", k) for k in range(4))]
    layout = PoseLayout(rows, torch.tensor([1.0, 0.0, 0.0, 0.0]).double())
    channels = torch.from_numpy(np.column_stack([place, turns.as_quat()[:, [3, 0, 1, 2]]]))
    shape = figure_of(layout, edges, channels)
    np.testing.assert_allclose(shape.nodes_m.mean(1), place, atol=1e-15)
    own = np.stack([turns[k].inv().apply(shape.nodes_m[k] - place[k]) for k in range(5)])
    np.testing.assert_allclose(np.ptp(own, axis=1), np.tile(edges.numpy(), (5, 1)))
    assert figure_of(PoseLayout(rows[:-1], layout.up), edges, channels) is None
