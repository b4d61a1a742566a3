"""What a law looks like, in the field's words."""

import pytest

from diffsim.diagnose.discover.look_alikes import look_alikes
from diffsim.identify.law import Entry, Law, Variable


def test_a_force_that_saturates_over_a_speed_is_dry_friction():
    """A cart that rubs on a slope was told to look like iron that saturates."""
    speed, force = Variable("v", "v"), Entry("force", "cart", "N", 1.0)
    law = Law("law_1", force, speed, "saturation", "size*tanh(u/width)", 1.0, "N")
    assert "dry friction" in look_alikes(law)[0]
    number = Law("law_2", Entry("number", "k", "N", 1.0), speed, "saturation", law.term, 1.0, "N")
    assert look_alikes(number) == ("iron that saturates", "limit")


@pytest.mark.parametrize(
    ("kind", "variable", "words"),
    [
        ("reading", Variable("order of the runs", "run_order"), "drifts from run to run"),
        ("number", Variable("order of the runs", "run_order"), "wear"),
        ("reading", Variable("force", "force", "N"), "cross-talk"),
    ],
)
def test_a_line_over_the_order_of_the_runs_is_a_drift(kind, variable, words):
    law = Law("law_1", Entry(kind, "y", "N", 1.0), variable, "line", "size*u", 1.0, "N")
    assert any(words in one for one in look_alikes(law))
