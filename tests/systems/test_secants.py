"""Steps made longer by secants: the fixed point of a linear map after as many steps as unknowns."""

import torch

from diffsim.systems.multicopter.secants import Secants

SPREAD = torch.tensor([0.3, 1.0, 2.0], dtype=torch.float64)
SHARE = 0.5  # of the way that every step leaves


def step_at(x, end):
    """Of a Gauss-Newton step that goes a share of the way to the end, turned a little."""
    turn = torch.tensor([[0.0, 0.1, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    slope = SHARE * torch.eye(3, dtype=torch.float64) + turn
    return ((torch.eye(3, dtype=torch.float64) - slope) @ ((end - x) / SPREAD)[..., None])[
        ..., 0
    ] * SPREAD


def test_a_linear_map_is_at_its_end_after_a_few_steps_in_every_window():
    end = torch.tensor([[0.1, -0.4, 0.7], [0.0, 0.2, 0.0]], dtype=torch.float64)
    x, secants, last = torch.zeros_like(end), Secants.none(2, SPREAD), None
    for _ in range(7):  # Broyden's method needs twice the number of unknowns at most
        step = step_at(x, end)
        if last is not None:
            secants = secants.learned(x - last[0], last[1], step)
        last, step = (x, step), secants.ahead(step)
        x = x + step
    torch.testing.assert_close(x, end, atol=1e-9, rtol=0.0)
    plain = torch.zeros_like(end)
    for _ in range(7):
        plain = plain + step_at(plain, end)
    assert float((plain - end).abs().max()) > 1e-3


def test_nothing_known_leaves_steps_as_they_are():
    step = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    torch.testing.assert_close(Secants.none(1, SPREAD).ahead(step), step, atol=1e-15, rtol=0.0)


def test_a_slope_of_one_makes_no_step_endless():
    step = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    slope = torch.eye(3, dtype=torch.float64)[None]
    for near in (1.0, 1.0 - 1e-9):
        torch.testing.assert_close(Secants(SPREAD, near * slope).ahead(step), step)


def test_steps_that_did_not_move_teach_nothing():
    none = Secants.none(1, SPREAD)
    moved = torch.zeros(1, 3, dtype=torch.float64)
    noise = torch.full((1, 3), 1e-12, dtype=torch.float64)
    assert torch.equal(none.learned(moved, noise, -noise).slope, none.slope)
