"""Causes that a user adds by a row, through every port."""

from dataclasses import replace

import pytest

from diffsim.causes.row import with_size
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study


def with_rows(study, *rows):
    """The study with causes of a user."""
    effects = dict(study.model.get("effects", {}))
    return replace(study, model={**study.model, "effects": {**effects, "own": list(rows)}})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"of": "forse"}, "did you mean 'force'"),
        ({"map": "u + siz"}, "'siz' is not known here; did you mean 'size'"),
        ({"map": "u", "law": "x"}, "stated by map alone"),
        ({"at": "law", "map": None, "law": "y"}, "no law for causes of your own"),
        ({"typical": "0.1*rech"}, "did you mean 'reach'"),
        ({"needs": "luck"}, "needs must be one of"),
        ({"at": "number", "map": None, "scale": "c", "of": "force"}, "leave of out"),
    ],
)
def test_a_wrong_row_is_refused_with_the_mend(change, said):
    row = {"name": "mine", "at": "command", "map": "u*(1 + size)", "typical": 0.1, **change}
    with pytest.raises(ValueError, match=said.replace("(", r"\(")):
        setup_of(with_rows(cart_study(), {k: v for k, v in row.items() if v is not None}))


def test_words_of_a_size_in_percent_have_a_space_before_the_sign():
    assert with_size("rotor 3 lost {:.0%} of its thrust", 0.16) == "rotor 3 lost 16 % of its thrust"
