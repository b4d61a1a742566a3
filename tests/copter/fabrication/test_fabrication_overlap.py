"""Parts that share space are found, with how deep; parts that only touch are not."""

import dataclasses
from functools import partial

import pytest

from diffsim.copter import load_design
from diffsim.copter.design.design import build_design
from diffsim.copter.fabrication import Printer, overlaps, plan


def box(size, at=(0.0, 0.0, 0.0)):
    import trimesh

    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def tube(radius, inner=None, height=0.06):
    import trimesh

    if inner is None:
        return trimesh.creation.cylinder(radius, height, sections=24)
    return trimesh.creation.annulus(inner, radius, height, sections=24)


def posed(mesh):
    import trimesh

    turn = trimesh.transformations.rotation_matrix(0.7, (0.3, 0.5, 0.8))
    return mesh.copy().apply_transform(turn)


@pytest.mark.reference
@pytest.mark.parametrize(
    ("a", "b", "depth"),
    [
        # two cubes of 40 mm, 34 mm apart: 6 mm are shared, 3 mm is as deep as a point can be
        (partial(box, (0.04,) * 3), partial(box, (0.04,) * 3, (0.034, 0.0, 0.0)), 3e-3),
        # a bar through a plate: no vertex of one lies in the other
        (partial(box, (0.3, 0.01, 0.01)), partial(box, (0.002, 0.2, 0.2)), 1e-3),
        # a box within a box, a part twice
        (partial(box, (0.01,) * 3, (0.02, 0.0, 0.0)), partial(box, (0.1,) * 3), 5e-3),
        (partial(box, (0.02, 0.03, 0.04)), partial(box, (0.02, 0.03, 0.04)), 1e-2),
        # a rod of 12 mm in a bore of 6 mm: a ring of 3 mm
        (partial(tube, 6e-3, height=0.1), partial(tube, 9e-3, inner=3e-3), 1.5e-3),
    ],
)
def test_depths_are_those_of_solids(a, b, depth):
    a, b = a(), b()
    for first, second in ((a, b), (posed(a), posed(b)), (posed(b), posed(a))):
        (found,) = overlaps({"a": first, "b": second})
        assert found.parts == ("a", "b")
        assert 0.8 * depth < found.depth < 1.001 * depth


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (partial(box, (0.04,) * 3), partial(box, (0.04,) * 3, (0.04, 0.0, 0.0))),  # faces touch
        (
            partial(box, (0.04,) * 3),
            partial(box, (0.04,) * 3, (0.0396, 0.01, 0.0)),
        ),  # within the saw's precision
        (partial(tube, 4e-3, height=0.1), partial(tube, 9e-3, inner=4e-3)),  # a rod in its bore
        (partial(box, (0.04,) * 3), partial(box, (0.04,) * 3, (0.03, 0.045, 0.0))),
    ],
)
def test_parts_that_touch_are_told_apart(a, b):
    a, b = a(), b()
    assert overlaps({"a": a, "b": b}) == ()
    assert overlaps({"a": posed(a), "b": posed(b)}) == ()


@pytest.mark.story  # a whole plan
def test_a_plan_reports_parts_that_interpenetrate():
    design = load_design("quadcopter")
    assert plan(design, printer=Printer(bed=(700.0, 700.0, 300.0))).overlaps == ()
    moved = tuple(
        dataclasses.replace(c, at=(0.0, 0.0)) if c.guest == "battery.bottom" else c
        for c in design.spec.connections
    )
    clash = plan(build_design(dataclasses.replace(design.spec, connections=moved)))
    names = {frozenset(o.parts) for o in clash.overlaps}
    assert frozenset({"battery", "bottom_plate__arm_y"}) in names
    assert clash.overlaps[0].depth > 2e-3
    assert any("battery" in p and "go into each other by" in p for p in clash.problems)
