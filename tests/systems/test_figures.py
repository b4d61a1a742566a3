"""Rods and balls in space, as pages of a diagnosis draw them."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data import load_study
from diffsim.systems.registry import setup_of
from tests.systems.rod import test_rod_description as rod
from tests.systems.test_rigid_body_description import GRAVITY, RADIUS, bouncing
from tests.systems.test_rigid_body_filmed import THROWS, folder

__all__ = ["folder"]  # a fixture

CORNERS = 12  # of a section as it is drawn
LOSS = CORNERS * np.sin(2.0 * np.pi / CORNERS) / (2.0 * np.pi)  # its area over the circle's


def arm(**changed):
    """A rod that hangs, its model and a run under a pull."""
    given = copy.deepcopy(rod.MODEL) | changed
    study = rod.study(given, noise=0.0)
    return setup_of(study).model, study.runs[4], study


def balls_of(shape):
    """Centers over time of the balls of a shape, (num_samples, num_balls, 3)."""
    import trimesh

    parts = trimesh.graph.connected_component_labels(
        trimesh.Trimesh(shape.nodes_m[0], shape.triangles, process=False).edges
    )
    return np.stack([shape.nodes_m[:, parts == k].mean(1) for k in np.unique(parts)], 1)


def test_a_rod_without_loads_is_drawn_as_its_stations_say():
    import trimesh

    model, run, _ = arm(gravity=[0, 0, 0])
    straight = replace(run, command={name: np.zeros(1) for name in run.command})
    shape = model.shape_at(straight, model.at_prior())
    solid = trimesh.Trimesh(shape.nodes_m[0], shape.triangles)
    assert solid.is_watertight and shape.closed
    a, b, length = 0.010, 0.005, 0.3
    cone = np.pi * length / 3.0 * (a * a + a * b + b * b)
    assert solid.volume == pytest.approx(LOSS * cone, rel=1e-6)  # positive: seen from outside
    np.testing.assert_allclose(solid.bounds[:, 2], [-0.3, 0.0], atol=1e-12)


def test_measured_markers_lie_on_the_simulated_rod():
    import trimesh

    model, run, study = arm()
    shape = model.shape_at(run, model.at_prior())
    dots = model.shape_of(run, torch.from_numpy(run.measured))
    centers = balls_of(dots)[0]
    np.testing.assert_allclose(centers, run.measured[0].reshape(2, 3), atol=1e-12)
    tip = shape.nodes_m[0, -1]
    np.testing.assert_allclose(tip, centers[1], atol=1e-9)  # "tip" is in the axis
    assert abs(tip[0]) + abs(tip[1]) > 0.03  # the pull bends it
    # "middle" sits 12 mm beside the axis of a rod that is 7.5 mm thick there
    skin = trimesh.Trimesh(shape.nodes_m[0], shape.triangles)
    _, away, _ = trimesh.proximity.closest_point_naive(skin, centers[:1])
    assert away[0] == pytest.approx(0.0045, abs=5e-4)
    seen = [c.name for c in study.channels]
    flat = {k: {"marker": k[:-2], "axis": k[-1]} for k in seen if k != "middle_x"}
    runs = tuple(replace(r, measured=r.measured[:, 1:]) for r in study.runs)
    changed = {"channels": study.channels[1:], "model": {**study.model, "channels": flat}}
    only = replace(study, runs=runs, **changed)
    shown = setup_of(only).model.shape_of(run, torch.from_numpy(run.measured[:, 1:]))
    assert balls_of(shown).shape == (1, 1, 3)  # of the other marker one coordinate is unknown


def test_a_rod_is_drawn_with_gravity_downwards():
    sideways = {"gravity": [-9.81, 0, 0], "base": {"along": [-1, 0, 0], "across": [0, 1, 0]}}
    tips = []
    for changed in ({}, sideways):
        model, run, _ = arm(**changed)
        tips.append(model.shape_at(run, model.at_prior()).nodes_m[0, -1])
    # both hang; turned about y, the first's sections begin along y as well
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-9)
    assert tips[0][2] < -0.2


def test_what_an_effect_changes_is_drawn():
    model, run, study = arm()
    thicker = next(e for e in setup_of(study).effects if e.name == "radius_offset")
    plain = model.shape_at(run, model.at_prior())
    grown = model.shape_at(run, model.at_prior(), {thicker: torch.tensor([1e-3])})
    ring = slice(0, CORNERS)
    radius = [np.ptp(s.nodes_m[0, ring], axis=0).max() / 2.0 for s in (plain, grown)]
    np.testing.assert_allclose(radius, [0.010, 0.011], rtol=1e-6)


@pytest.mark.parametrize("up", ["z", "y"])
def test_thrown_balls_are_drawn_where_they_were_measured_and_simulated(up):
    study = bouncing(up=up)
    model, run = setup_of(study).model, study.runs[1]
    shown = model.shape_of(run, torch.from_numpy(run.measured))
    centers = balls_of(shown)[:, 0]
    upright = run.measured if up == "z" else run.measured[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(centers, upright, atol=1e-12)
    simulated = model.shape_at(run, model.at_prior())
    predicted = model.shape_of(run, model.predict(run, model.at_prior()))
    np.testing.assert_allclose(simulated.nodes_m, predicted.nodes_m, atol=1e-12)
    assert np.ptp(simulated.nodes_m[0, :, 2]) == pytest.approx(2.0 * RADIUS, rel=1e-3)
    assert 0.0 <= simulated.nodes_m[..., 2].min() < RADIUS  # it bounces on 0, between samples


def test_a_filmed_ball_is_drawn_where_it_is_simulated(folder):
    setup = setup_of(load_study(folder))
    study, model = setup.study, setup.model
    run = next(r for r in study.runs if r.name == "throw1")
    assert model.shape_of(run, torch.from_numpy(run.measured)) is None  # pixels tell no distance
    q = model.at_prior()
    start = {p.name: p.value for p in model.base}
    shape = model.shape_at(run, q)
    x, vz, z = (start[f"ball_{n}@throw1"] for n in ("x", "vz", "z"))
    t = run.time_s - run.time_s[0]
    centers = balls_of(shape)[:, 0]
    np.testing.assert_allclose(centers[:, 2], z + vz * t - 0.5 * GRAVITY * t**2, atol=1e-3)
    assert abs(centers[-1, 0] - x) == pytest.approx(THROWS[0][0] * t[-1], rel=0.1)
    clicks = next(r for r in study.runs if r.name == "calibration_points")
    assert model.shape_at(clicks, q) is None
