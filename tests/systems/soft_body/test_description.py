"""Soft bodies described in a study: keys, what they make, and what is wrong in terms of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from diffsim import mesh
from diffsim.data.study import Channel
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.model_file import SavedModel, rebuilt
from diffsim.systems.registry import setup_of
from diffsim.systems.soft_body.quasi_static import pose_commands

from .described import BAR, TENDON, described, predicted, run_of, study_of

TIMES = np.arange(-1, 24) * 0.02
LIGHT, HEAVY = run_of("light", TIMES, load_kg=0.0), run_of("heavy", TIMES, load_kg=0.03)


def pulled(amount_m: float = 4e-3) -> np.ndarray:
    return amount_m * 0.5 * (1.0 - np.cos(2 * np.pi * np.arange(24) / 12))


PULLED = run_of("pulled", np.arange(24) * 0.05, command={"pull_m": pulled()})


def test_what_a_description_makes():
    study = study_of(BAR, (LIGHT, HEAVY))
    made = described(study)
    assert not made.problems(study)
    setup = setup_of(study)
    assert [p.name for p in setup.model.base] == ["youngs_modulus", "rayleigh_beta"]
    names = {e.name for e in setup.effects}
    assert {"load_inertia", "tip_mass", "loss_factor", "body_scale", "sensor_delay"} <= names
    # a base parameter is no cause beside itself, and nothing pulls here
    assert not {"stiffness_damping", "slack", "rate_limit", "current"} & names


def test_rubber_of_a_second_invariant_has_its_share_in_the_study():
    """Without the share it is neo-Hookean; with it another motion, and a share that is fitted."""
    keys = study_of(BAR, (HEAVY,)).model["material"]

    def moved(**changes):
        setup = setup_of(study_of(BAR, (HEAVY,), material=keys | changes))
        return setup.model, setup.model.predict(HEAVY, setup.model.at_prior())

    neo, none = moved(law="neo_hookean")[1], moved(law="mooney_rivlin")[1]
    torch.testing.assert_close(none, neo, rtol=0.0, atol=1e-9)
    share = {"value": 0.3, "sd": 0.1, "lower": 0.0, "upper": 1.0}
    model, half = moved(law="mooney_rivlin", second_share=share)
    assert "second_share" in [p.name for p in model.base]
    assert float((half - neo).abs().max()) > 1e-6
    with pytest.raises(ValueError, match="stvk has none, leave it out"):
        moved(law="stvk", second_share=0.2)


def test_a_hung_weight_pulls_and_its_inertia_slows():
    study = study_of(BAR, (LIGHT, HEAVY))
    light, plain = predicted(study)
    heavy = predicted(study, {"load_inertia": 1.0})[1]
    assert light[0] == plain[0] == 0.0  # held until the start
    first_dip = {k: int(y[:, 0].argmin()) for k, y in (("plain", plain), ("heavy", heavy))}
    assert float(plain.min()) < 1.5 * float(light.min()) < 0.0
    assert first_dip["heavy"] > first_dip["plain"]


@pytest.mark.parametrize("motion", ["dynamic", "quasi_static"])
def test_the_surface_that_pages_show_moves_as_the_markers_do(motion):
    kind, run = (BAR, HEAVY) if motion == "dynamic" else (TENDON, PULLED)
    corner = {"corner": [0.08, 0.0, 0.0]}
    channels = {"tip_z_m": {"markers": "corner", "axis": "z", "scale": 2.0}}
    study = study_of(kind, (run,), markers=corner, channels=channels)
    problem = Problem(setup_of(study).model, study.runs, WhiteNoise(study.channels), ())
    x = torch.zeros(len(problem.names), dtype=torch.float64)
    shape = problem.shape_at(study.runs[0], x)
    assert shape is not None and shape.nodes_m.shape[0] == len(run.time_s)
    body = setup_of(study).model.scene(study.runs[0], x, {}).body.mesh
    used = torch.unique(mesh.surface_triangles(body).faces)
    here = int((body.nodes[used] - torch.tensor(corner["corner"])).norm(dim=-1).argmin())
    read = problem.predict(study.runs[0], x)[:, 0].detach().numpy()
    np.testing.assert_allclose(2.0 * shape.nodes_m[:, here, 2], read, atol=1e-12)
    assert shape.triangles.max() < len(used) == shape.nodes_m.shape[1]


def test_a_fact_may_have_a_unit_and_who_states_none_is_told():
    study = study_of(BAR, (HEAVY, run_of("same", TIMES, load_kg="30 g"), run_of("silent", TIMES)))
    heavy, same, silent = predicted(study)
    assert torch.equal(heavy, same) and not torch.allclose(heavy, silent)
    (warning,) = described(study).problems(study)
    assert warning.severity == "warning" and warning.message.endswith("no load_kg: silent")


def test_a_load_as_a_mass_is_a_weight_with_its_inertia():
    study = study_of(BAR, (LIGHT, HEAVY))
    load = {"name": "weight", "where": {"x": 0.08}, "mass_from": "load_kg", "acts_as": "mass"}
    as_mass = predicted(study_of(BAR, (LIGHT, HEAVY), masses=[load]))[1]
    assert torch.allclose(predicted(study, {"load_inertia": 1.0})[1], as_mass, atol=1e-9)


@pytest.mark.grad
def test_the_slope_of_a_mass_from_nothing_is_that_of_the_adjoint():
    """It was half of it: differences reached below zero, where a mass is none."""
    study = study_of(BAR, (LIGHT,))
    setup = setup_of(study)
    (mass,) = (e for e in setup.effects if e.name == "tip_mass")
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), (mass,))
    x = np.zeros(len(problem.names))
    slope = problem.linearize(x)[1][:, -1]
    along = slope / np.linalg.norm(slope)
    assert problem.pullback(x, along)[-1] == pytest.approx(np.linalg.norm(slope), rel=1e-3)


def test_a_density_per_part_goes_with_hooks():
    region = {"name": "head", "where": {"x": [0.06, None]}, "density": 2000.0}
    study = study_of(BAR, (LIGHT,), regions=[region], vibration={"frequency": 5.0})
    at_rest = predicted(study)[0]
    assert not torch.allclose(at_rest, predicted(study_of(BAR, (LIGHT,)))[0])
    assert not torch.allclose(at_rest, predicted(study, {"creep": 0.05})[0])


def meshed(tmp_path, regions, *, file=None, **changes):
    """The bar as a mesher's file in mm whose far quarter is called 1, and a study of it."""
    bar = mesh.hex_box((8, 1, 1), (80.0, 16.0, 16.0))
    far = (bar.nodes[bar.elements].mean(1)[:, 0] > 60.0).long()
    mesh.save(bar, tmp_path / "bar.vtu", element_data={"part": far, "oven": 1 - far})
    body = {"file": {"path": "bar.vtu", "unit": "mm", "groups": "part", **(file or {})}}
    return replace(study_of(BAR, (LIGHT,), body=body, regions=regions, **changes), folder=tmp_path)


def test_regions_of_the_mesh_file_have_their_own_material(tmp_path):
    head = {"name": "head", "youngs_modulus": {"value": "2 MPa", "percent": 30}, "density": 9e3}
    by_name = meshed(tmp_path, [head | {"group": "1"}])
    by_place = meshed(tmp_path, [head | {"where": {"x": [0.06, None]}}])
    assert torch.equal(predicted(by_name)[0], predicted(by_place)[0])
    assert not torch.equal(predicted(by_name)[0], predicted(meshed(tmp_path, []))[0])
    setup = setup_of(by_name)
    assert "youngs_modulus_head" in [p.name for p in setup.model.base]  # is fitted
    problem = Problem(setup.model, by_name.runs, WhiteNoise(by_name.channels), ())
    column = problem.linearize(np.zeros(len(problem.names)))[1]
    assert np.abs(column[:, problem.names.index("youngs_modulus_head")]).max() > 0.0


def test_regions_follow_the_cells_that_are_kept(tmp_path):
    head = {"name": "head", "density": 9e3}
    kept = {"keep": {"x": [None, 0.07]}}
    markers = {"markers": {"tip": [0.069, 0.008, 0.0]}}
    same = [
        predicted(meshed(tmp_path, [head | place], file=kept, masses=[], start={}, **markers))[0]
        for place in ({"group": "1"}, {"where": {"x": [0.06, None]}})
    ]
    assert torch.equal(*same)


@pytest.mark.parametrize(
    ("place", "file", "message"),
    [
        ({"group": "2"}, {}, r"regions\[0\].group: name of a region must be one of"),
        ({"group": "1"}, {"groups": None}, r"regions\[0\].group: .*several cell data"),
        ({"group": "1"}, {"keep": {"x": [None, 0.05]}}, "none of the cells that are kept"),
        ({"group": "1", "where": {"x": 0.0}}, {}, "give one of where, group"),
        ({}, {}, "give one of where, group"),
    ],
)
def test_groups_that_are_not_there(tmp_path, place, file, message):
    study = meshed(tmp_path, [{"name": "head", "density": 9e3} | place], file=file, masses=[])
    with pytest.raises(ValueError, match=message):
        setup_of(study)


def test_a_bar_has_no_groups():
    region = {"name": "head", "group": "1", "density": 9e3}
    with pytest.raises(ValueError, match=r"regions\[0\].group: only a body from a mesh file"):
        setup_of(study_of(BAR, (LIGHT,), regions=[region]))


def test_poses_follow_the_command_and_are_computed_once():
    study = study_of(TENDON, (PULLED,))
    (there,) = predicted(study)
    # the same command, the same pose: there and back
    assert torch.allclose(there[1:12], there[1:12].flip(0), atol=1e-9)
    late = predicted(study, {"delay": 0.1})[0]
    assert torch.allclose(late[4:], there[2:-2], atol=1e-5)


def test_a_frozen_model_follows_a_larger_stroke_than_it_was_fitted_to():
    """It was refused: poses were spread over the new stroke, so sizes "meant something else"."""
    study = study_of(TENDON, (PULLED,))
    further = study_of(TENDON, (replace(PULLED, command={"pull_m": pulled(9e-3)}),))
    model = setup_of(study).model
    base = {p.name: p for p in model.base}
    saved = SavedModel(
        path=Path("extended_model.yaml"),
        values={name: p.value for name, p in base.items()},
        sd={name: p.sd for name, p in base.items()},
        units={name: p.unit for name, p in base.items()},
        parameters=tuple(base),
        components=(),
        frame=dict(model.frame),
    )
    again = rebuilt(saved, setup_of(saved.framed(further)))
    assert again.frame == model.frame
    run = further.runs[0]
    there = again.predict(run, again.at_prior()).detach()
    fresh = setup_of(further).model  # poses of its own, over all of the larger stroke
    own = fresh.predict(run, torch.zeros(len(base), dtype=torch.float64)).detach()
    assert float(own.abs().max()) > 2e-3
    np.testing.assert_allclose(there, own, atol=1e-3 * float(own.abs().max()))


def test_poses_go_on_at_their_spacing():
    fitted = pose_commands((0.0, 1.0), (0.0, 1.0), 12)
    assert fitted is not None and float(fitted[-1]) == pytest.approx(1.1)
    more = pose_commands((0.0, 1.0), (-0.05, 1.4), 12)
    assert more is not None
    np.testing.assert_allclose(more.diff(), 0.1, rtol=1e-12)
    assert float(more[-1]) >= 1.4 * 1.1 and float(more[0]) <= -0.05
    assert set(fitted.tolist()) <= set(more.tolist())
    assert len(pose_commands((0.0, 1.0), (0.0, 1e6), 12)) < 200  # a wrong unit costs no hours
    assert pose_commands((0.0, 0.0), (0.0, 0.0), 12) is None


@pytest.mark.parametrize(
    ("numerics", "error"),  # 19 % by neither
    [
        ({"correct_mesh": True}, 0.01),
        ({"correct_mesh": False, "element": "assumed_strain"}, 0.06),
    ],
)
def test_a_commanded_force_bends_as_its_moment_does(numerics, error):
    cable = {
        "name": "cable", "command": "pull_N", "means": "force",
        "path": [[0, 0.005, 0.002], [0.08, 0.005, 0.002]],
    }  # fmt: skip
    run = run_of("pulled", np.arange(6) * 1.0, command={"pull_N": np.full(6, 0.05)})
    study = study_of(TENDON, (run,), tendons=[cable])
    study.model["body"] = {"bar": {"size": [0.08, 0.01, 0.016], "cells": [10, 2, 4]}}
    study.model["numerics"] |= numerics
    tip = float(predicted(study)[0][-1, 0])
    inertia = 0.01 * 0.016**3 / 12
    wanted = -0.05 * 0.006 * 0.08**2 / (2 * 0.3e6 * inertia)  # M L^2 / (2 E I)
    assert tip == pytest.approx(wanted, rel=error)


def test_a_mass_that_a_run_states_as_a_word_is_told():
    masses = [{"where": {"x": 0.08}, "mass_from": "load_kg"}]
    study = study_of(BAR, (run_of("light", TIMES, load_kg="brass"),), masses=masses)
    said = "run light: setup.load_kg: must be a number in kg, or one with its unit, got 'brass'"
    with pytest.raises(ValueError, match=said):
        setup_of(study)


def test_a_missing_command_and_a_path_outside():
    cable = {"name": "cable", "command": "pul_m", "axial_stiffness": 100.0}
    path = [[0, 0.005, 0.004], [0.08, 0.005, 0.004]]
    study = study_of(TENDON, (PULLED,), tendons=[cable | {"path": path}])
    with pytest.raises(ValueError, match=r"tendons\[0\].command: run pulled has no"):
        setup_of(study)
    outside = cable | {"command": "pull_m", "path": [[0, 0.0, 0.1], [0.08, 0.0, 0.1]]}
    with pytest.raises(ValueError, match=r"tendons\[0\].path: path must lie inside the mesh"):
        setup_of(study_of(TENDON, (PULLED,), tendons=[outside]))


def test_shapes_of_all_kinds(tmp_path):
    stations = [{"at": 0, "radius": "10 mm"}, {"at": "80 mm", "radius": "5 mm"}]
    rod = {"rod": {"stations": stations, "cells": 6}, "rotation": [0, "90 deg", 0]}
    study = study_of(
        BAR, (LIGHT,), body=rod, fixed=[{"z": 0}], masses=[], start={},
        markers={"tip": [0, 0, "-79 mm"]},
    )  # fmt: skip
    assert not described(study).problems(study)
    mesh.save(mesh.hex_box((4, 1, 1), (80.0, 16.0, 16.0)), tmp_path / "bar.vtu")
    study = replace(
        study_of(BAR, (LIGHT,), body={"file": {"path": "bar.vtu", "unit": "mm"}}), folder=tmp_path
    )
    assert not described(study).problems(study)


def test_a_rotation_is_read_in_radians():
    reading = {"markers": ["low", "high"], "about": "y"}
    markers = {"low": [0.08, 0.008, 0.0], "high": [0.08, 0.008, 0.016]}
    channels = (Channel("pitch_rad", "rad", "angle", 1e-3),)
    study = study_of(
        BAR, (LIGHT,), channels, markers=markers, channels={"pitch_rad": reading}
    )  # fmt: skip
    pitch = predicted(study)[0][:, 0]
    drop = predicted(study_of(BAR, (LIGHT,)))[0][:, 0]
    last = float(pitch[-1] / (-drop[-1] / 0.08))  # a sagging tip turns nose down, about +y
    assert 1.0 < last < 1.6  # 4/3 under its own weight
