"""What a law looks like, in the field's words."""

import pytest

from diffsim.diagnose.discover.look_alikes import look_alikes
from diffsim.identify.law import Entry, Law, Variable


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
