"""Causes that a user adds by a row, through every port."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.causes.row import with_size
from diffsim.identify import Problem, WhiteNoise
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study

ONE = {"value": 1.0, "sd": 0.1}


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
        (
            {"at": "force", "map": None, "law": "size*v", "of": "cart", "shapes": {"v": ONE}},
            "'v' is",
        ),
        ({"shapes": {"size": ONE}}, "'size' is a letter"),
    ],
)
def test_a_wrong_row_is_refused_with_the_mend(change, said):
    row = {"name": "mine", "at": "command", "map": "u*(1 + size)", "typical": 0.1, **change}
    with pytest.raises(ValueError, match=said.replace("(", r"\(")):
        setup_of(with_rows(cart_study(), {k: v for k, v in row.items() if v is not None}))


def test_words_of_a_size_in_percent_have_a_space_before_the_sign():
    assert with_size("rotor 3 lost {:.0%} of its thrust", 0.16) == "rotor 3 lost 16 % of its thrust"


@pytest.mark.parametrize("letter", ["width", "inertia", "slow", "stop"])
def test_a_number_of_a_row_is_its_formulas_alone(letter):
    """Called as the library calls one of its own, it was the width of all friction, too."""
    study = cart_study()
    run = study.fit_runs[0]

    def moved(name):
        law = f"-size*tanh(v/w)*exp(-(v/{name})**2)"
        row = {"name": "mine", "at": "force", "of": "cart", "law": law, "typical": 0.1}
        setup = setup_of(with_rows(study, row | {"shapes": {name: ONE}}))
        effect = next(e for e in setup.effects if e.name == "mine")
        problem = Problem(setup.model, (run,), WhiteNoise(study.channels), (effect,))
        return problem.record(np.where([n == "mine" for n in problem.names], 1.0, 0.0))

    np.testing.assert_array_equal(moved(letter), moved("stribeck"))
