"""Commands of time alone: signals in closed form, bounds, batches, gradients."""

import math

import pytest
import torch

from diffsim.control import Knots, Sinusoid

VALUES = [[0.0], [0.6], [-0.2], [0.4]]


def at(signal: Knots | Sinusoid, *times: float) -> torch.Tensor:
    return signal.signal(torch.tensor(times, dtype=torch.float64)).detach()[:, 0]


def close(found: torch.Tensor, wanted: list[float]) -> None:
    torch.testing.assert_close(found, torch.tensor(wanted).double(), rtol=0, atol=1e-12)


def test_a_sinusoid_has_its_amplitudes_frequency_and_phases():
    controller = Sinusoid(2, 0.01, frequency=1.5, amplitudes=[0.5, 0.75], phases=[0.0, 0.5])
    time = torch.linspace(0.0, 1.0, 7, dtype=torch.float64)
    turn = 2.0 * math.pi * 1.5 * time
    wanted = torch.stack([0.5 * turn.sin(), 0.75 * (turn + 0.5).sin()], -1)
    torch.testing.assert_close(controller.signal(time), wanted, rtol=0, atol=1e-12)
    # the third step of a batch of four that it does not look at
    steps = controller(torch.zeros(4, 9).double(), 3)
    torch.testing.assert_close(steps, controller.signal(torch.tensor(0.03)).expand(4, 2))


def test_a_phase_may_be_held():
    controller = Sinusoid(1, 0.01, phases=[0.3], learn_phases=False)
    assert {n for n, p in controller.named_parameters() if p.requires_grad} == {
        "raw_frequency",
        "raw_amplitude",
    }


def test_lines_between_knots_end_at_the_last_and_are_held():
    knots = Knots(1, 0.1, num_knots=4, duration=3.0, start=torch.tensor(VALUES))
    close(at(knots, 0.0, 0.5, 1.0, 2.5, 3.0, 9.0), [0.0, 0.3, 0.6, 0.1, 0.4, 0.4])


def test_a_periodic_signal_goes_from_its_last_knot_to_its_first():
    knots = Knots(1, 0.1, num_knots=4, duration=4.0, periodic=True, start=torch.tensor(VALUES))
    wanted = [0.0, 0.6, 0.1, 0.4, 0.2, 0.0, 0.6]
    close(at(knots, 0.0, 1.0, 2.5, 3.0, 3.5, 4.0, 9.0), wanted)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sinusoid(1, 0.01, frequency=9.0), "frequency must lie within frequency_range"),
        (lambda: Sinusoid(1, 0.01, amplitudes=[1.0]), "amplitudes must lie in"),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
