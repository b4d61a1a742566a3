"""Equilibria of slender rods against closed forms, a second solver, and differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_bvp

from diffsim.core.errors import ConvergenceError
from diffsim.systems.rod import _ops
from diffsim.systems.rod.layout import points_on, rod_shape
from diffsim.systems.rod.statics import RodStatics
from tests.helpers import check_layer, with_derivatives

RADIUS, LENGTH, YOUNG = 0.01, 1.0, 1e6
STIFFNESS = YOUNG * np.pi * RADIUS**4 / 4  # against bending [N m^2]
TENSE = 1e6  # factor on stretch and shear stiffness: closed forms know neither
F64 = torch.float64


def rod(
    cells, *, force=0.0, pull=0.0, distance=0.004, friction=0.0, density=0.0, taper=1.0, end=1.0
):
    """A clamped rod along x with a weight at its end and a tendon towards y."""
    ends = np.array([RADIUS, taper * RADIUS])
    shape = rod_shape(np.array([0.0, LENGTH]), ends, cells, [end * LENGTH])
    count = len(shape.radius)
    bending = YOUNG * shape.inertia[:, None] * torch.tensor([2 / 2.9, 1.0, 1.0], dtype=F64)
    stretch = TENSE * YOUNG * shape.area[:, None].expand(count, 3)
    offset = torch.zeros(1, count, 3, dtype=F64)
    offset[..., 1] = distance
    down = torch.tensor([0.0, 0.0, -1.0], dtype=F64)
    inside = (shape.middles < end * LENGTH).to(F64)
    return RodStatics(
        shape=shape,
        bending=bending,
        stretch=stretch,
        rest=torch.zeros(count, 3, dtype=F64),
        stiffening=torch.zeros((), dtype=F64),
        weight=density * 9.81 * (shape.area * shape.lengths)[:, None] * down,
        points=points_on(shape, ["end"], [LENGTH], [(0.0, 0.0, 0.0)]),
        loads=(force * down)[None],
        base=torch.eye(3, dtype=F64),
        place=torch.zeros(3, dtype=F64),
        offset=offset,
        slope=torch.zeros(1, count, 3, dtype=F64),
        share=inside[None],
        pull=torch.tensor([pull], dtype=F64),
        friction=torch.tensor(friction, dtype=F64),
        wobble=torch.zeros((), dtype=F64),
        rubber=torch.zeros((), dtype=F64),
    )


def solved(made, **how):
    """Strains (N, 3) of a rod that comes from straight, and the place of its end (3)."""
    start = torch.zeros(1, len(made.shape.radius), 3, dtype=F64)
    u, places = made.solve(made.points, made.points.offset, start, 1e-11, straight=True, **how)
    return u[0, 0], places[0, 0, 0].numpy()


def bent(made):
    return solved(made)[0]


def end_of(made):
    return solved(made)[1]


def elastica(load):
    """End of a clamped elastica under load L^2 / EI across, (along, across), by scipy."""

    def rates(s, y):  # angle, bend, x, y
        return np.vstack([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

    def ends(a, b):
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0.0, 1.0, 200)
    guess = np.zeros((4, len(s)))
    guess[0], guess[2] = s, s
    solved = solve_bvp(rates, ends, s, guess, tol=1e-10, max_nodes=100000)
    assert solved.success
    return solved.y[2, -1], abs(solved.y[3, -1])


@pytest.mark.reference
def test_a_load_at_the_end_bends_it_like_the_elastica():
    along, across = elastica(4.0)
    assert across == pytest.approx(0.66996, abs=1e-5)  # Bisshopp and Drucker 1945
    x, _, z = end_of(rod(80, force=4.0 * STIFFNESS))
    assert x == pytest.approx(along, abs=2e-5)
    assert -z == pytest.approx(across, abs=2e-5)


@pytest.mark.order
def test_the_error_falls_with_the_square_of_the_elements():
    along, across = elastica(4.0)
    errors = []
    for cells in (10, 20, 40):
        x, _, z = end_of(rod(cells, force=4.0 * STIFFNESS))
        errors.append(np.hypot(x - along, -z - across))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.reference
def test_small_weight_bends_it_like_a_beam():
    density = 1.0
    load = density * 9.81 * np.pi * RADIUS**2
    _, _, z = end_of(rod(80, density=density))
    assert -z == pytest.approx(load * LENGTH**4 / (8.0 * STIFFNESS), rel=2e-3)


@pytest.mark.reference
def test_a_parallel_tendon_bends_it_to_a_circle_as_far_as_it_goes():
    pull, distance = 8.0, 0.004
    bend = pull * distance / STIFFNESS
    u = bent(rod(20, pull=pull, end=0.6))
    inside = rod(20, end=0.6).shape.middles < 0.6
    assert u[inside, 2].numpy() == pytest.approx(bend, rel=1e-5)
    assert u[~inside].abs().max() < 1e-9
    x, y, _ = end_of(rod(80, pull=pull))
    assert (x, y) == pytest.approx((np.sin(bend) / bend, (1.0 - np.cos(bend)) / bend), abs=1e-4)


@pytest.mark.reference
def test_a_tendon_shortens_it_by_its_force_over_the_stiffness():
    made = rod(20, pull=5.0, distance=0.0)
    made = replace(made, stretch=made.stretch / TENSE)
    x, _, _ = end_of(made)
    assert x == pytest.approx(1.0 - 5.0 / (YOUNG * np.pi * RADIUS**2), rel=1e-6)


@pytest.mark.reference
def test_pressed_rubber_is_stiffer_and_its_tendons_are_farther_out():
    """Stretch y of P = E (y - y^-2) / 3, and the circle of a lever y^-1/2 against P'(y) I / y."""
    pull, distance = 40.0, 0.002
    made = rod(20, pull=pull, distance=distance)
    made = replace(made, stretch=made.stretch / TENSE, rubber=torch.ones((), dtype=F64))
    force = pull / (YOUNG * np.pi * RADIUS**2)
    y = max(np.roots([1.0, 3.0 * force, 0.0, -1.0]).real)
    assert y < 0.92  # 13 % without it
    u = bent(made)
    v = made.survey(u[None, None]).stretches[0, 0]
    # four rounds of the stretch leave 4e-5 where 11 % are pressed together
    assert v[:, 0].numpy() == pytest.approx(y, abs=1e-4)
    bend = pull * distance * y**0.5 / (STIFFNESS * (1.0 + 2.0 * y**-3) / 3.0)
    assert u[:, 2].numpy() == pytest.approx(bend, rel=5e-4)  # it goes with y^3.5
    soft = bent(replace(made, rubber=torch.zeros((), dtype=F64)))
    assert float(soft[0, 2]) > 1.15 * bend


@pytest.mark.reference
def test_friction_around_a_bend_follows_the_capstan_law():
    made = rod(60, pull=8.0, friction=0.3)
    u = bent(made)
    tension = made.survey(u[None, None]).tensions[0, 0, :, 0].numpy()
    bends = u[:, 2].numpy()
    angle = 0.5 * (bends[1:] + bends[:-1]).sum() * LENGTH / 60  # from middle to middle
    assert tension[-1] / tension[0] == pytest.approx(np.exp(-0.3 * angle), rel=1e-5)
    assert tension[-1] < 0.7 * tension[0]


@pytest.mark.reference
def test_weight_beyond_an_element_turns_with_a_rod_that_hangs_sideways():
    """A heavy tapered rod bent far, against a boundary value problem solved by scipy."""
    density, taper, pull, distance = 300.0, 0.6, 6.0, 0.004

    def radius(s):
        return RADIUS * (1.0 - (1.0 - taper) * s)

    def beyond(s):  # weight of the rest
        volume = np.pi / 3.0 * (1.0 - s)
        return (
            9.81 * density * volume * (radius(s) ** 2 + radius(s) * radius(1.0) + radius(1.0) ** 2)
        )

    def rates(s, y):  # angle down from x, moment, x, z
        bend = y[1] / (YOUNG * np.pi * radius(s) ** 4 / 4)
        return np.vstack([bend, -beyond(s) * np.cos(y[0]), np.cos(y[0]), -np.sin(y[0])])

    def ends(a, b):
        return np.array([a[0], b[1] - pull * distance, a[2], a[3]])

    s = np.linspace(0.0, 1.0, 400)
    guess = np.stack([s, 1.0 - s, s, -s])
    solved = solve_bvp(rates, ends, s, guess, tol=1e-9, max_nodes=200000)
    assert solved.success and solved.y[0, -1] > 1.0  # it does turn
    ends = []
    for cells in (20, 40):
        made = rod(cells, density=density, taper=taper, pull=pull)
        offset = torch.zeros_like(made.offset)
        offset[..., 2] = -distance  # below the axis: it bends further down
        ends.append(end_of(replace(made, offset=offset))[[0, 2]])
    errors = [e - solved.y[2:, -1] for e in ends]
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.2)
    assert (4.0 * ends[1] - ends[0]) / 3.0 == pytest.approx(solved.y[2:, -1], abs=1e-4)


def general(rows=1, columns=1):
    """A rod with all that the kernel knows, differently in each row or column of some numbers."""
    made = rod(5, density=300.0, taper=0.6, end=0.8)  # 6 elements
    count = len(made.shape.radius)
    random = torch.Generator().manual_seed(0)

    def about(value, *lead):
        value = torch.as_tensor(value, dtype=F64)
        noise = torch.rand(*lead, *value.shape, generator=random, dtype=F64)
        return value * (0.9 + 0.2 * noise) + 1e-3 * noise

    offset = torch.zeros(2, count, 3, dtype=F64)
    offset[0, :, 1], offset[1, :, 2] = 0.006, -0.005
    return replace(
        made,
        bending=about(made.bending, rows, 1),
        stretch=about(made.stretch / TENSE, 1, 1),
        rest=about(0.2 * torch.ones(count, 3), 1, columns),
        stiffening=about(0.3, rows, 1),
        weight=about(made.weight, rows, 1),
        points=points_on(
            made.shape, ["a", "b"], [0.35, 1.0], [(0.0, 0.01, 0.0), (0.01, 0.0, 0.02)]
        ),
        loads=about(torch.tensor([[0.0, 0.0, -0.02], [0.01, 0.0, -0.03]]), rows, 1),
        base=about(made.base, 1, 1),
        place=about(made.place, rows, columns),
        offset=about(offset, rows, 1),
        slope=about(0.01 * torch.ones(2, count, 3), 1, 1),
        share=about(made.share.expand(2, count), rows, 1),
        pull=about(torch.tensor([3.0, 5.0]), rows, columns),
        friction=about(0.2, rows, 1),
        wobble=about(0.1, rows, 1),
        rubber=about(0.8, rows, 1),
    )


@pytest.mark.reference
def test_a_rod_with_everything_bends_as_in_other_arithmetic():
    """Places by the same balance written in PyTorch's operations, before it was compiled."""
    end = end_of(general())
    assert end == pytest.approx([0.1635394, 0.04949164, -0.25481798], abs=1e-8)


def test_each_member_of_a_batch_is_itself_whatever_it_starts_from():
    made = general(3, 2)
    seen = made.points
    start = torch.zeros(2, 6, 3, dtype=F64)
    u, places = made.solve(seen, seen.offset, start, 1e-11)
    assert made.survey(u).residual.abs().max() < 1e-12
    lead = {name: len(spec.shape) - 2 for name, spec in _ops.FIELDS.items() if name != "points"}
    for row, column in ((0, 0), (2, 1)):
        own = {}
        for name, axes in lead.items():
            value = getattr(made, name)
            if value.ndim == axes + 2:
                value = value[min(row, value.shape[0] - 1), min(column, value.shape[1] - 1)]
            own[name] = value
        alone, end = solved(replace(made, **own))
        torch.testing.assert_close(u[row, column], alone, atol=1e-9, rtol=0.0)
        assert places[row, column, 0].numpy() == pytest.approx(end, abs=1e-10)


def test_members_side_by_side_have_the_answers_and_gradients_of_each_alone():
    """19 members: more than two registers of any build, and some that are left over."""
    made = general(19, 1)
    started = torch.zeros(19, 1, 6, 3, dtype=F64)
    started[3] = 40.0  # far from rest

    def answers(rows):
        own = {
            name: value[rows].clone() if value.ndim and len(value) == 19 else value.clone()
            for name, value in ((n, getattr(made, n)) for n in _ops.FIELDS if n != "points")
        }
        own = {name: value.requires_grad_() for name, value in own.items()}
        u, places = replace(made, **own).solve(
            made.points, made.points.offset, started[rows], 1e-11
        )
        (gradient,) = torch.autograd.grad(places.square().sum() + u.sum(), own["pull"])
        return u.detach(), gradient

    u, gradient = answers(slice(None))
    for row in (0, 3, 18):
        alone, own = answers(slice(row, row + 1))
        torch.testing.assert_close(u[row : row + 1], alone, atol=1e-9, rtol=0.0)
        torch.testing.assert_close(gradient[row : row + 1], own, atol=0.0, rtol=1e-7)


@pytest.mark.story  # every input; a plain run has the contract of kinds
@pytest.mark.grad
def test_derivatives_of_an_equilibrium_are_those_of_differences():
    made = general(2, 2)
    given = made._op_arguments(torch.zeros(2, 6, 3, dtype=F64), made.points, made.points.offset)
    given |= {"tolerance": 1e-12, "straight": False, "num_threads": 1}
    args = [given[name] for name in _ops.rod_solve.arguments]
    factors = [torch.ones_like(given[name]).requires_grad_() for name in _ops.FIELDS]

    def layer(*factors):  # so that differences are small beside each number
        scaled = {n: given[n] * f for n, f in zip(_ops.FIELDS, factors, strict=True)}
        strains, places, _ = _ops.rod_solve(**given | scaled)
        return torch.cat([0.1 * strains.flatten(), places.flatten()])

    ops = with_derivatives(_ops.rod_solve, *args)
    check_layer(layer, factors, ops=ops, fast_mode=True, atol=1e-8, rtol=1e-7)


@pytest.mark.parametrize("bend", [3.5, 4.5, 6.0])  # of the tendon alone, from end to end [rad]
def test_a_hanging_rod_that_is_lifted_until_it_turns_over_comes_to_rest(bend):
    made = rod(24, force=3.0 * STIFFNESS, pull=bend * STIFFNESS / 0.008, density=8.4)
    made.offset[..., 2] = 0.008  # the tendon runs above, and from no tension there is no way
    made.offset[..., 1] = 0.0
    u, end = solved(made)
    assert float(made.survey(u[None, None]).residual.abs().max()) < 1e-9 * STIFFNESS
    assert end[2] > -0.5


def test_no_equilibrium_is_said():
    with pytest.raises(ConvergenceError, match="no equilibrium"):
        bent(rod(8, pull=float("nan")))
