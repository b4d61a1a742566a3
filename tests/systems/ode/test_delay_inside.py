"""A definition that acts late, such as a controller's torque, beside causes of its command."""

import numpy as np
import pytest

from diffsim.diagnose.checks.gradients import gradient_gate
from diffsim.identify import Problem, WhiteNoise
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study, described


def servo(held, *names):
    """A problem of a cart's position servo with causes, those of its inside and of its command."""
    model = described(
        inputs=[{"name": "force", "held": held}],
        define={"push": "60*(0.05*force - x) - 4*v"},
        rates={"x": "v", "v": "(push - c*v)/m"},
    )
    study = cart_study(model=model)
    setup = setup_of(study)
    effects = tuple(e for e in setup.effects if e.name in names)
    assert len(effects) == len(names)
    return Problem(setup.model, study.fit_runs[:2], WhiteNoise(study.channels), effects)


@pytest.mark.grad
@pytest.mark.parametrize("held", [True, False])
def test_its_adjoint_at_no_delay_is_the_slope_of_delays(held):
    """A branch at zero hid it, and every answer with a controller was "not certain" for it."""
    problem = servo(held, "delay_inside_push")
    x = np.zeros(len(problem.names))
    (gate,) = gradient_gate(problem, x, *problem.linearize(x)[:2])
    assert gate.name == "gradient:delay_inside_push"
    assert gate.passed and gate.applies


@pytest.mark.parametrize("other", ["slow_share", "gain_drift"])
def test_causes_of_a_command_act_inside_a_definition_that_is_not_late(other):
    """The late command was the one as given: its copy took the other cause out again."""
    alone, beside = servo(True, other), servo(True, other, "delay_inside_push")
    moved = []
    for problem in (alone, beside):
        x = np.zeros(len(problem.names))
        (effect,) = (e for e in problem.effects if e.name == other)
        x[problem.columns_of(effect)] = 0.3
        moved.append(problem.record(x) - problem.record(np.zeros(len(x))))
    assert np.abs(moved[0]).max() > 1e-4
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-12)
