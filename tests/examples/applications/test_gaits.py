"""The applications that move, at their quick sizes: they go further, and their slopes are true."""

import dataclasses
import math

import numpy as np
import pytest

from examples.applications import evaluate, minimize, solver_options
from tests.examples.stories import load_story


def quick(name, *, rtol=None, steps=None, refine=1):
    module = load_story(f"applications/{name}.py")
    if steps is not None:
        module.STEPS = steps
    solver = solver_options("projective_dynamics", rtol=rtol or module.RTOL)
    return module.build(solver, True, refine)


def meaning(application, values):
    return application.numbers(np.array(values), application.motion(np.array(values)))


@pytest.mark.short_of("test_quadruped_goes_further_than_its_best_random_signal")
def test_a_search_goes_on_from_its_best_random_signal():
    application = dataclasses.replace(quick("quadruped", steps=80), num_starts=2)
    found = minimize(application, max_evaluations=2)
    assert found.num_starts == 2
    start = found.evaluations[2]
    assert start.loss == min(e.loss for e in found.evaluations[:2])
    assert found.best.loss < start.loss


@pytest.mark.story
def test_torus_learns_to_roll():
    application = quick("torus")
    found = minimize(application, max_evaluations=8)
    start = found.evaluations[found.num_starts]
    assert found.num_starts == 4
    assert found.best.loss < 3.0 * start.loss < 0.0  # best of the random signals: 5 cm
    after = meaning(application, found.best.values)
    # it rolls, it does not slide: outer radius 0.112 m
    assert after["turned degrees"] > 60.0
    rolled = 112.0 * math.radians(after["turned degrees"])
    assert rolled == pytest.approx(after["travel mm"], rel=0.3)
    assert after["largest tilt degrees"] < 15.0
    assert abs(after["drift mm"]) < 0.05 * after["travel mm"]


@pytest.mark.slow
def test_quadruped_goes_further_than_its_best_random_signal():
    application = dataclasses.replace(quick("quadruped", steps=160), num_starts=3)
    found = minimize(application, max_evaluations=3)
    start = found.evaluations[found.num_starts]
    assert found.num_starts == 3 and start.loss == min(e.loss for e in found.evaluations[:3])
    assert found.best.loss < start.loss < 0.0
    after = meaning(application, found.best.values)
    assert after["largest tilt degrees"] < 45.0
    assert abs(after["drift mm"]) < 0.05 * after["travel mm"]


@pytest.mark.slow
def test_quadruped_goes_as_far_with_half_the_time_step():
    command = (0.855, 0.081, 6.94)  # where the search over whole gaits ends
    one, half = (meaning(quick("quadruped", refine=k), command) for k in (1, 2))
    assert one["travel body lengths"] > 1.5
    assert half["travel mm"] == pytest.approx(one["travel mm"], rel=0.1)
    assert half["largest tilt degrees"] < 45.0


@pytest.mark.slow
def test_quadruped_of_full_size_goes_as_far_under_refinement():
    """Half robot: 449 mm, and 461, 467 and 460 with half and a quarter of the step, finer cells."""
    module = load_story("applications/quadruped.py")

    def travel(refine, cells):
        solver = solver_options("newton_cholesky", rtol=1e-3 if cells > 1 else 1e-4)
        made = module.build(solver, False, refine, cells, half=True)
        return meaning(made, made.parameters.first)["travel mm"]

    usual = travel(1, 1)
    assert usual > 400.0
    for refined in (travel(2, 1), travel(4, 1), travel(1, 2)):
        assert refined == pytest.approx(usual, rel=0.1)


@pytest.mark.parametrize(("name", "steps"), [("torus", None), ("quadruped", 120), ("cow", 80)])
def test_slope_is_the_central_difference(name, steps):
    """Over a stretch in which feet touch and leave; the whole of a gait amplifies rounding."""
    application = quick(name, rtol=1e-10, steps=steps)
    span = application.parameters.upper - application.parameters.lower
    values = application.parameters.values(
        0.8 * application.parameters.scaled(application.parameters.first) + 0.1
    )
    gradient = np.array(evaluate(application, values).gradient) * span
    way, eps = gradient / np.linalg.norm(gradient), 1e-5
    up, down = (
        evaluate(application, values + s * eps * way * span, gradient=False).loss
        for s in (1.0, -1.0)
    )
    assert np.linalg.norm(gradient) > 1e-3
    assert gradient @ way == pytest.approx((up - down) / (2.0 * eps), rel=0.02)


def test_cow_is_rewarded_for_height():
    application = quick("cow", steps=8)
    x = application.motion(application.parameters.first)
    lifted = x.clone()
    lifted[-1, :, 2] += 0.01
    parameters = None
    gain = float(application.loss(parameters, x) - application.loss(parameters, lifted))
    assert gain == pytest.approx(0.3 * 0.01, rel=1e-9)


@pytest.mark.parametrize("name", ["torus", "quadruped", "cow"])
def test_refined_time_steps_cover_the_same_time(name):
    one, two = quick(name, steps=8), quick(name, steps=8, refine=2)
    assert two.body.dt == pytest.approx(0.5 * one.body.dt)
    if name == "torus":
        return  # its quick length is fixed
    a, b = (len(app.motion(app.parameters.first)) - 1 for app in (one, two))
    assert b == 2 * a


@pytest.mark.parametrize("name", ["torus", "quadruped", "cow"])
def test_thesis_sizes(name):
    """Thesis Table 4.2: elements (within 7 %); time steps of legged robots are ours."""
    module = load_story(f"applications/{name}.py")
    application = module.build(solver_options("projective_dynamics", rtol=module.RTOL), False)
    elements, dt, steps, parameters = {
        "torus": (568, 0.004, 400, 160),
        "quadruped": (648, 0.0025, 400, 3),
        "cow": (475, 0.002, 300, 3),
    }[name]
    assert application.body.mesh.num_elements == pytest.approx(elements, rel=0.07)
    assert (application.body.dt, module.STEPS) == (dt, steps)
    assert len(application.parameters.names) == parameters
    assert application.num_starts == (16 if name == "torus" else 1)
    assert application.oracle is None


def test_routing_tendon_reaches_for_its_target():
    module = load_story("applications/routing_tendon.py")
    application = module.build(solver_options("projective_dynamics", rtol=module.RTOL), True)
    found = minimize(application, max_evaluations=8)
    before = meaning(application, application.parameters.first)["distance mm"]
    after = meaning(application, found.best.values)["distance mm"]
    assert after < 0.5 * before


@pytest.mark.slow
def test_cow_of_full_size_goes_as_far_under_refinement():
    """232 mm, and 218, 223 and 214 with half and a quarter of the step, finer cells."""
    module = load_story("applications/cow.py")

    def travel(refine, cells):
        solver = solver_options("newton_cholesky", rtol=1e-3 if cells > 1 else 1e-4)
        made = module.build(solver, False, refine, cells, half=cells == 2)
        return meaning(made, made.parameters.first)["travel mm"]

    usual = travel(1, 1)
    assert usual > 200.0
    for refined in (travel(2, 1), travel(4, 1), travel(1, 2)):
        assert refined == pytest.approx(usual, rel=0.1)
