"""Bodies of robots: sizes, what commands do, what sensors and attitude say."""

import math
import pickle
from dataclasses import fields, replace

import pytest
import torch

from diffsim import soft
from diffsim.systems import robots
from diffsim.systems.robots.robot import spread_nodes

THESIS = {  # elements, degrees of freedom (Table 4.2); what ours may differ
    "starfish": (1492, 7026, 0.04, 0.02),
    "shark": (2256, 9921, 0.07, 0.02),
    "quadruped": (648, 3180, 0.0, 0.02),
    "cow": (475, 2488, 0.05, 0.05),
    "torus": (568, 3204, 0.02, 0.05),
    "tendon_arm": (512, 2475, 0.0, 0.0),
}


def push(robot: robots.SoftRobot, command: int, steps: int = 4) -> torch.Tensor:
    """How nodes have moved under one full command, without floor or water."""
    free = replace(robot, obstacles=(), water=None)
    row = torch.zeros(len(robot.command_names), dtype=torch.float64)
    row[command] = 1.0
    pushed = quiet = robot.body.rest_state()
    for _ in range(steps):
        pushed = free.step(pushed, row)
        quiet = free.step(quiet, torch.zeros_like(row))
    return (pushed.x - quiet.x).detach()


@pytest.mark.parametrize("name", sorted(THESIS))
def test_sizes_of_the_thesis(name: str) -> None:
    elements, dofs, more_elements, more_dofs = THESIS[name]
    robot = getattr(robots, name)()
    assert robot.body.mesh.num_elements == pytest.approx(elements, rel=more_elements)
    assert robot.num_dofs == pytest.approx(dofs, rel=more_dofs)


@pytest.mark.parametrize("name", sorted(THESIS))
def test_coarse_robots_are_small_and_as_large(name: str) -> None:
    fine, coarse = getattr(robots, name)(), getattr(robots, name)(coarse=True)
    assert 400 < coarse.num_dofs < 1500
    assert coarse.command_names == fine.command_names
    assert len(coarse.sensors) == len(fine.sensors) == len(set(coarse.sensors.tolist()))
    spans = [r.body.x_rest.amax(0) - r.body.x_rest.amin(0) for r in (coarse, fine)]
    assert bool(((spans[0] / spans[1] - 1.0).abs() < (0.55 if name == "cow" else 0.3)).all())


@pytest.mark.parametrize("coarse", [True, False])
def test_starfish_is_symmetric_and_bends_the_arm_it_is_told(coarse: bool) -> None:
    robot = robots.starfish(coarse=coarse)
    x = robot.body.x_rest
    torch.testing.assert_close(x.sum(0)[:2], torch.zeros(2).double(), rtol=0.0, atol=1e-9)
    counts = [int((robot.body.muscles.owner == k).sum()) for k in range(8)]
    assert len(set(counts)) == 1
    tips = [x[:, 0].argmax(), x[:, 1].argmax(), x[:, 0].argmin(), x[:, 1].argmin()]
    for command in range(4):
        drop = push(robot, command)[tips, 2]
        others = drop[[k for k in range(4) if k != command]]
        assert float(drop[command] - others.mean()) < -5.0 * float(
            (others - others.mean()).abs().max()
        )


@pytest.mark.parametrize("coarse", [True, False])
def test_shark_is_symmetric_and_bends_its_tail_left(coarse: bool) -> None:
    robot = robots.shark(coarse=coarse)
    x = robot.body.x_rest
    assert float(robot.center(x)[1]) == pytest.approx(0.0, abs=1e-9)
    tail, nose = int(x[:, 0].argmin()), int(x[:, 0].argmax())
    moved = push(robot, 0)
    middle = moved[(x[:, 0] / x[:, 0].amin() - 0.45).abs() < 0.05, 1].mean()
    assert float(moved[tail, 1] - middle) > 0.0
    assert float(moved[nose, 1] - middle) > 0.0  # a bow: both ends go the same way


@pytest.mark.parametrize("make", [robots.quadruped, robots.cow])
def test_legs_bend_towards_the_shortened_side(make) -> None:  # type: ignore[no-untyped-def]
    robot = make(coarse=True)
    feet = robot.body.x_rest[:, 2] < 1e-9
    x = robot.body.x_rest
    middle = x[feet].mean(0)
    for command, name in enumerate(robot.command_names):
        moved = push(robot, command)
        of_leg = feet & ((x[:, 0] > middle[0]) == ("front" in name.split(" of ")[1]))
        of_leg &= (x[:, 1] > middle[1]) == ("left" in name)
        rest = feet & ~of_leg
        ahead = float(moved[of_leg, 0].mean() - moved[rest, 0].mean())
        assert (ahead > 0.0) == name.startswith("shorten front of")
        assert float(moved[of_leg].norm(dim=1).mean()) > float(moved[rest].norm(dim=1).mean())


def test_two_commands_move_all_legs() -> None:
    robot = robots.quadruped(coarse=True, per_muscle=False)
    activation = robot.activation(torch.tensor([1.0, -0.5], dtype=torch.float64))
    torch.testing.assert_close(activation, torch.tensor([0.7, 1.15] * 4, dtype=torch.float64))


def test_torus_shortens_the_eighth_it_is_told() -> None:
    robot = robots.torus(coarse=True)
    x = robot.body.x_rest
    assert float(x[:, 2].min()) == pytest.approx(0.0, abs=1e-12)
    center = robot.center(x)
    turn = torch.atan2(x[:, 0], center[2] - x[:, 2]) % (2.0 * torch.pi)
    for k in range(8):
        moved = push(robot, k, steps=6)
        out = ((x - center) * moved)[:, [0, 2]].sum(1)  # ends of the eighth come together
        near = (turn > (k - 0.01) * torch.pi / 4) & (turn < (k + 1.01) * torch.pi / 4)
        tangent = torch.stack([torch.cos(turn), torch.sin(turn)], 1)
        along = (moved[:, [0, 2]] * tangent).sum(1)
        first, last = (
            near & (turn < (k + 0.4) * torch.pi / 4),
            near & (turn > (k + 0.6) * torch.pi / 4),
        )
        assert float(along[first].mean()) > float(along[last].mean())
        assert bool(out.isfinite().all())


def test_arm_leans_towards_the_shortened_corner() -> None:
    robot = robots.tendon_arm(coarse=True)
    tip = int(robot.sensors[-1])
    torch.testing.assert_close(
        robot.body.x_rest[tip], torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64)
    )
    for command, name in enumerate(robot.command_names):
        moved = push(robot, command, steps=30)
        assert (float(moved[tip, 0]) > 0.0) == ("+x" in name)
        assert (float(moved[tip, 1]) > 0.0) == ("+y" in name)
        assert not bool(moved[robot.body.fixed[:, 0]].any())


@pytest.mark.parametrize("make", [robots.starfish, robots.shark])
def test_small_commands_are_heard(make) -> None:  # type: ignore[no-untyped-def]
    """The tolerance of a step is no dead zone, in which gradients would lie."""
    robot = make(coarse=True)

    def motion(command: float) -> float:
        state = robot.body.rest_state()
        row = torch.full((len(robot.command_names),), command, dtype=torch.float64)
        for _ in range(8):
            state = robot.step(state, row)
        return float((state.x - robot.body.x_rest).norm(dim=1).max()) / command

    assert motion(0.03) == pytest.approx(motion(0.3), rel=0.15)


@pytest.mark.parametrize("friction", [0.0, math.inf])
def test_friction_is_the_callers(friction: float) -> None:
    """Pushed along x, a quadruped slides on ice and stays where contacts stick (the thesis)."""
    robot = robots.quadruped(coarse=True, friction=friction)
    x = robot.body.x_rest
    state = soft.State(x, torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64).expand_as(x))
    for _ in range(3):
        state = robot.step(state, torch.zeros(8, dtype=torch.float64))
    feet = x[:, 2] < 1e-9
    slid = float((state.x - x)[feet, 0].abs().max())
    assert slid == pytest.approx(0.009 if friction == 0.0 else 0.0, abs=2e-3)


def test_robots_survive_pickling() -> None:
    robot = robots.shark(coarse=True)
    copy = pickle.loads(pickle.dumps(robot))
    command = torch.tensor([0.5], dtype=torch.float64)
    state = robot.body.rest_state()
    torch.testing.assert_close(
        copy.step(state, command).x, robot.step(state, command).x, rtol=0.0, atol=0.0
    )


def test_water_is_still_where_the_robot_drifts_with_it() -> None:
    robot = robots.starfish(coarse=True)
    x = robot.body.x_rest
    wind = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    state = soft.State(x, wind.expand_as(x).clone())
    assert not bool(robot.force(state, water_velocity=wind).any())
    one, half = robot.force(state), robot.force(state, gain=torch.tensor(0.5).double())
    torch.testing.assert_close(half, 0.5 * one)
    assert float((one.sum(0) * wind).sum()) < 0.0
    assert robots.quadruped(coarse=True).force(state) is None


def test_spread_nodes_are_far_apart() -> None:
    line = torch.stack([torch.linspace(0.0, 1.0, 11), torch.zeros(11), torch.zeros(11)], 1).double()
    assert sorted(spread_nodes(line, 3).tolist()) == [0, 5, 10]
    with pytest.raises(ValueError, match="count must be at most 11"):
        spread_nodes(line, 12)


@pytest.mark.parametrize("name", ["quadruped", "cow"])
@pytest.mark.parametrize("coarse", [False, True])
def test_muscles_of_legs_keep_their_place_on_finer_meshes(name: str, coarse: bool) -> None:
    def volumes_and_centers(refine: int) -> tuple[torch.Tensor, torch.Tensor]:
        body = getattr(robots, name)(coarse=coarse, refine=refine).body
        corners = body.x_rest[body.mesh.hexes][body.muscles.elements]
        volume = (corners.amax(1) - corners.amin(1)).prod(1)
        of = [body.muscles.owner == k for k in range(8)]
        center = [(volume[k, None] * corners[k].mean(1)).sum(0) / volume[k].sum() for k in of]
        return torch.stack([volume[k].sum() for k in of]), torch.stack(center)

    volume, center = volumes_and_centers(1)
    for refine in (2, 3):
        finer_volume, finer_center = volumes_and_centers(refine)
        torch.testing.assert_close(finer_volume, volume, rtol=1e-9, atol=0.0)
        torch.testing.assert_close(finer_center, center, rtol=0.0, atol=1e-9)


def test_half_a_quadruped_moves_as_the_left_half_of_a_whole_one() -> None:
    whole, half = (
        robots.quadruped(per_muscle=False, youngs_modulus=3e5, damping=0.02, rtol=1e-9, half=h)
        for h in (False, True)
    )
    assert half.body.muscles.num_muscles == 4
    assert half.command_names == whole.command_names
    # nodes of the half among those of the whole, by their places
    apart = torch.cdist(half.body.x_rest, whole.body.x_rest)
    nearest, same = apart.min(1)
    assert float(nearest.max()) < 1e-6  # cells are of 1 cm
    command = torch.tensor([0.9, -0.1], dtype=torch.float64)
    a, b = half.body.rest_state(), whole.body.rest_state()
    for _ in range(4):
        a, b = half.step(a, command), whole.step(b, command)
    moved = float((b.x - whole.body.x_rest).abs().max())
    assert moved > 5e-3
    assert float((a.x - b.x[same]).abs().max()) < 1e-8 * moved


@pytest.mark.parametrize(
    ("options", "message"),
    [({}, "give per_muscle=False"), ({"per_muscle": False, "coarse": True}, "even refine")],
)
def test_halves_that_cannot_be_made_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        robots.quadruped(half=True, **options)


def test_a_force_of_ones_own_is_what_a_step_takes() -> None:
    """The step in water is one node of the graph, which once left such a force out."""

    class Pushed(robots.SoftRobot):
        def force(self, state, **options):
            return super().force(state, **options) + 1.0  # N

    plain = robots.starfish(coarse=True)
    own = Pushed(**{f.name: getattr(plain, f.name) for f in fields(plain) if f.init})
    state, row = plain.body.rest_state(), torch.zeros(len(plain.command_names)).double()
    expected = soft.step(
        plain.body, state, external_force=own.force(state), activation=plain.activation(row)
    )
    assert torch.equal(own.step(state, row).x, expected.x)
    assert not torch.equal(plain.step(state, row).x, expected.x)
