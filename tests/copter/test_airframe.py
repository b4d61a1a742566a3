"""Mirrored airframes, agile flight with its gradient, and choices by branch and bound."""

import dataclasses

import numpy as np
import pytest
import torch

from diffsim.copter import rotor_model
from diffsim.copter.airframe import Airframe, Parts
from diffsim.copter.waypoints import WEIGHTS, WaypointTask
from diffsim.core.errors import DiffsimError

SHORT = WaypointTask(num_episodes=3, seconds=0.3)


def moved(task: WaypointTask, seed: int = 0, size: float = 0.05) -> np.ndarray:
    """A point near the conventional design, where some streams overlap."""
    x = task.start.numpy().copy()
    return np.clip(x + size * np.random.default_rng(seed).uniform(-1.0, 1.0, len(x)), 0.0, 1.0)


def tensor(x):
    return torch.from_numpy(np.asarray(x, dtype=np.float64))


def test_the_conventional_hexarotor_is_flat_regular_and_just_free():
    airframe = Airframe()
    places, axes = (t.numpy() for t in airframe.rotors(airframe.conventional))
    np.testing.assert_allclose(axes, np.tile([0.0, 0.0, -1.0], (6, 1)), atol=1e-15)
    assert np.abs(places[:, 2]).max() < 1e-15
    angles = np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 360.0
    np.testing.assert_allclose(angles, [30.0, 90.0, 150.0, 210.0, 270.0, 330.0], atol=1e-9)
    gaps = airframe.gaps(airframe.conventional)
    assert gaps.shape == (15 + 6,)
    assert 0.0 <= float(gaps.min()) < 1e-4
    vehicle = airframe.vehicle(airframe.conventional)
    assert vehicle.spins.tolist() == [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]
    np.testing.assert_allclose(vehicle.positions, places, atol=1e-15)


def test_designs_are_mirrored_and_weigh_what_their_parts_do():
    airframe = Airframe(num_pairs=2)
    xi = tensor(np.random.default_rng(3).uniform(size=10))
    vehicle = airframe.vehicle(xi)
    places, axes = airframe.rotors(xi)
    for part in (places, axes):
        np.testing.assert_allclose(part.flip(0) * tensor([1.0, -1.0, 1.0]), part, atol=1e-15)
    np.testing.assert_allclose(axes.norm(dim=1), 1.0, atol=1e-15)
    # the same from small pieces: a thousand beads per tube, corners of eight cuboids
    parts = airframe.parts
    beads = (np.arange(1000) + 0.5)[:, None] / 1000.0
    pieces = [(parts.rotor_mass, p.numpy()[None]) for p in places]
    for p in places:
        pieces.append((parts.arm_density * float(p.norm()), beads * p.numpy()))
    grid = np.stack(np.meshgrid(*[(np.arange(40) + 0.5) / 40.0 - 0.5] * 3), -1).reshape(-1, 3)
    pieces.append((parts.core_mass, grid * np.array(parts.cage)))
    mass = np.concatenate([np.full(len(r), m / len(r)) for m, r in pieces])
    at = np.concatenate([r for _, r in pieces])
    middle = mass @ at / mass.sum()
    about = at - middle
    inertia = np.einsum("n,nij->ij", mass, (about**2).sum(1)[:, None, None] * np.eye(3)
                        - about[:, :, None] * about[:, None, :])  # fmt: skip
    assert float(vehicle.mass) == pytest.approx(mass.sum(), rel=1e-12)
    np.testing.assert_allclose(vehicle.inertia, inertia, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(vehicle.positions, places.numpy() - middle, atol=1e-12)


def test_gaps_are_those_of_points_on_the_axes():
    airframe = Airframe()
    rng = np.random.default_rng(5)
    for _ in range(5):
        xi = tensor(rng.uniform(size=15))
        places, axes = airframe.rotors(xi)
        half, along = 2.0 * airframe.parts.radius, tensor(np.linspace(-1.0, 1.0, 201))
        lines = places[:, None] + half * along[None, :, None] * axes[:, None]
        i, j = torch.triu_indices(6, 6, 1)
        least = np.array([torch.cdist(lines[a], lines[b]).min() for a, b in zip(i, j, strict=True)])
        gaps = airframe.gaps(xi).numpy()
        np.testing.assert_allclose(gaps[:15] + 2.0 * airframe.stream_radius, least, atol=2e-3)
        assert (gaps[:15] + 2.0 * airframe.stream_radius <= least + 1e-12).all()


@pytest.mark.grad
@pytest.mark.parametrize("free_gain", [False, True])
def test_gradient_through_hover_lqr_and_flight(free_gain):
    task = dataclasses.replace(SHORT, free_gain=free_gain)
    x = moved(task)
    loss, gradient = task.value_and_gradient(x)
    for wrong in (x[:-1], x * np.nan, "text", None, [Ellipsis]):
        for ask in (task.value, task.value_and_gradient, task.smallest_gap):
            with pytest.raises((TypeError, ValueError), match=r"\bx must"):
                ask(wrong)
    assert loss == pytest.approx(task.value(x), rel=1e-12)
    assert len(gradient) == 15 + len(WEIGHTS) + (72 if free_gain else 0)
    rng = np.random.default_rng(1)
    for _ in range(3):
        way, h = rng.standard_normal(len(x)), 1e-6
        slope = (task.value(x + h * way) - task.value(x - h * way)) / (2.0 * h)
        assert gradient @ way == pytest.approx(slope, rel=1e-5)
    assert (np.abs(gradient[:15]) > 0.0).any() and (np.abs(gradient[15:]) > 0.0).any()


def test_free_entries_add_up_to_the_largest_of_their_column():
    """At 0.5 nothing is added, at 0 and 1 as much as the column's largest entry."""

    def gain(x, free_gain):
        keep = lambda *_, feedback, **__: feedback.gain  # noqa: E731
        return dataclasses.replace(SHORT, free_gain=free_gain, flies=keep).fly(tensor(x))

    x, share = moved(SHORT), np.linspace(0.0, 1.0, 72)
    own = gain(x, False)
    added = own.abs().amax(0) * tensor(2.0 * share - 1.0).view_as(own)
    torch.testing.assert_close(gain(np.append(x, share), True), own + added)


def test_an_overlap_has_its_price_and_a_gap_none():
    free = SHORT.start.numpy()
    flight = SHORT.distances(SHORT.fly(tensor(free))).mean()
    assert SHORT.value(free) == float(flight)
    tight = free.copy()
    tight[:15:5] *= 0.5
    assert SHORT.smallest_gap(tight) < -0.01
    assert SHORT.value(tight) > float(SHORT.distances(SHORT.fly(tensor(tight))).mean()) + 1.0


def test_waypoints_are_reached():
    task = WaypointTask(num_episodes=2, num_waypoints=1, seconds=6.0)
    x = task.start.numpy()
    for name, value in (("x, y", 0.76), ("z", 0.6), ("roll, pitch", 0.1), ("u, v", 0.2)):
        x[15 + list(WEIGHTS).index(name)] = value
    away = task.distances(task.fly(tensor(x)))
    assert float(away[:, 0].min()) == pytest.approx(task.distance - 0.05, abs=0.01)
    assert float(away[:, -1].max()) < 0.06 * task.distance
    assert task.weights(x)["x, y"] == pytest.approx(10.0**1.8)


def test_what_the_catalog_lacks_is_taken_from_its_kin():
    small = Parts.of(rotor_model("f40iii_gemfan5045x3"), rotor_mass=0.04, core_mass=0.3)
    assert small.torque_ratio == pytest.approx(0.115 * 0.0635)
    large = Parts.of(rotor_model("kde2814_10in"), rotor_mass=0.16, core_mass=0.3)
    assert large.torque_ratio == pytest.approx(0.01466397479)
    assert large.torque_ratio / large.radius == pytest.approx(0.115, abs=5e-4)


# Choices.


def line(choice):
    """Figures of a made-up choice: two numbers that pull apart, and a quality."""
    share, quality = choice
    if quality < 0.0:
        raise DiffsimError("does not hover")
    return quality * share, quality * (1.0 - share)


def roof(choice):
    share, quality = choice
    return tuple(1.1 * v for v in (abs(quality) * share, abs(quality) * (1.0 - share)))


CHOICES = [(s, q) for s in (0.1, 0.3, 0.5, 0.7, 0.9) for q in (0.2, 0.5, 0.9, 1.0, -1.0)]


def test_the_front_is_that_of_all_choices_and_most_are_never_solved():
    from diffsim.copter.codesign import choose

    asked = []

    def counted(choice):
        asked.append(choice)
        return line(choice)

    found = choose(CHOICES, roof, counted, at_once=1)
    best = {c: line(c) for c in CHOICES if c[1] >= 0.0}
    front = {
        c
        for c, f in best.items()
        if not any(g[0] >= f[0] and g[1] >= f[1] and g != f for g in best.values())
    }
    assert set(found.choices) == front == {(s, 1.0) for s in (0.1, 0.3, 0.5, 0.7, 0.9)}
    assert len(asked) + len(found.pruned) == len(CHOICES)
    assert len(found.pruned) >= 10 and not set(found.pruned) & front
    assert [why for _, why in found.failed] == ["does not hover"] * len(found.failed)
    assert list(found.figures[:, 0]) == sorted(found.figures[:, 0], reverse=True)
    # as good as a bound, no more is to be had
    tied = choose([(0.5, 1.0)] * 4, line, line, at_once=1)
    assert (len(tied.solved), len(tied.pruned)) == (1, 3)


def test_bounds_that_do_not_hold_are_refused():
    from diffsim.copter.codesign import choose

    with pytest.raises(ValueError, match=r"bound of .* must not be exceeded"):
        choose(CHOICES[:1], lambda c: (0.01, 0.01), line)
    with pytest.raises(DiffsimError, match="none of 1 choices has a solution: does not hover"):
        choose([(0.5, -1.0)], roof, line)
    with pytest.raises(ValueError, match="choices is empty"):
        choose([], roof, line)


def test_payload_of_arms_reaches_the_bound_and_an_executor_changes_nothing():
    pytest.importorskip("cvxpy")
    from diffsim.copter.codesign import Demands, Limits, SearchOptions, codesign
    from diffsim.copter.codesign.arms import ArmSpace
    from diffsim.core import open_executor

    space = ArmSpace(airframe=Airframe(num_pairs=2))
    few = SearchOptions(num_starts=2)
    found = codesign(space, "payload", spins="given", search=few)
    assert found.max_weight == pytest.approx(4 * space.airframe.parts.max_thrust, rel=1e-5)
    demands = Demands(authority=(0.3, 0.3, 0.03))
    with open_executor("processes:1") as workers:
        kept = [
            codesign(
                space,
                "payload",
                spins="given",
                demands=demands,
                limits=Limits(clearance=0.005),
                search=few,
                executor=given,
            )
            for given in (None, workers)
        ]
    assert kept[0].max_weight < 0.9 * found.max_weight
    assert torch.equal(kept[0].s, kept[1].s)
    with pytest.raises(ValueError, match="longest"):
        ArmSpace(airframe=Airframe(num_pairs=2), longest=1.2)
