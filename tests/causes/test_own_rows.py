"""Causes that a user adds by a row, through every port."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from diffsim.systems.registry import setup_of
from tests.systems.outside import scenes
from tests.systems.toy_cart import cart_study

ROWS = {
    "command": {"at": "command", "map": "u*(1 + size*t)", "typical": 0.1},
    "reading": {"at": "reading", "map": "u + size*abs(u)", "typical": "0.1*width"},
    "clock": {"at": "clock", "unit": "s", "typical": 0.01},
    "number": {"at": "number", "scale": "damping", "typical": 0.1},
    "force": {"at": "force", "of": "PLACE", "law": "-size*x*abs(x)", "typical": "push"},
}
STUDIES = {"ode": (cart_study, "c", "cart"), "outside": (scenes.recorded, "damping", "hinge")}


def with_rows(study, *rows):
    """The study with causes of a user."""
    effects = dict(study.model.get("effects", {}))
    return replace(study, model={**study.model, "effects": {**effects, "own": list(rows)}})


def row_for(system, port):
    made, number, place = STUDIES[system]
    row = {"name": f"own_{port}", **ROWS[port]}
    row |= {"scale": number} if port == "number" else {}
    row |= {"of": place} if port == "force" else {}
    return made(), row


@pytest.mark.parametrize("port", ROWS)
@pytest.mark.parametrize("system", STUDIES)
def test_a_row_acts_through_each_port_and_is_nothing_at_zero(system, port):
    study, row = row_for(system, port)
    setup = setup_of(with_rows(study, row))
    effect = next(e for e in setup.effects if e.name == row["name"])
    run, q = study.runs[0], setup.model.at_prior()
    plain = setup.model.predict(run, q)
    size = torch.tensor([effect.typical], dtype=torch.float64)
    torch.testing.assert_close(
        setup.model.predict(run, q, {effect: 0.0 * size}), plain, rtol=0, atol=1e-12
    )
    assert float((setup.model.predict(run, q, {effect: size}) - plain).abs().max()) > 1e-6


def test_a_row_is_the_library_s_own_cause_of_the_same_map():
    study = cart_study()
    row = {"name": "mine", "at": "command", "map": "lagged", "unit": "s", "typical": 0.03}
    setup = setup_of(with_rows(study, row))
    effects = {e.name: e for e in setup.effects}
    size = torch.tensor([0.02], dtype=torch.float64)
    run, q = study.runs[0], setup.model.at_prior()
    mine, its = (setup.model.predict(run, q, {effects[n]: size}) for n in ("mine", "lag"))
    torch.testing.assert_close(mine, its, rtol=0, atol=0)


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
