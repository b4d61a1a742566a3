"""The tables of causes: each cause once, every row able to act, words complete."""

import re
from collections import Counter
from pathlib import Path

import pytest

import diffsim
from diffsim.causes import all_rows, domains, rows
from diffsim.causes.row import ANY, Row
from tests.scripts import load_script

LETTERS = re.compile(r"[a-z][a-z0-9_]*")


def test_no_cause_is_defined_twice():
    names = Counter(row.name for _, row in all_rows())
    assert len(names) > 150
    assert [name for name, count in names.items() if count > 1] == []


# courses in time without a form, which have a component per knot; numerics; events in time, of
# which each block of a study makes its own; formulas of a user
NO_ROWS = {
    "causes/row.py",
    "identify/numerics.py",
    "identify/setup.py",  # terms of a law without a form
    "systems/multicopter/unknown.py",
    "systems/ode/event_effects.py",
    "systems/ode/law_port.py",  # courses and terms without a form, which no row can state
    "systems/ode/own_effects.py",
    "systems/ode/unknown.py",
    "systems/outside/effects.py",
    "systems/soft_body/unknown.py",
}


def test_causes_are_defined_in_tables_alone():
    folder = Path(diffsim.__file__).parent
    made = re.compile(r"(?<![\w.\"])(Numerical)?Effect\((apply|\n)")
    found = {
        str(path.relative_to(folder))
        for path in folder.rglob("*.py")
        if made.search(path.read_text(encoding="utf-8"))
    }
    assert found <= NO_ROWS


@pytest.mark.parametrize("domain", domains())
def test_every_row_is_said_in_words(domain):
    for row in rows(domain).values():
        assert LETTERS.fullmatch(row.name), row.name
        assert row.form.endswith("."), row.name
        assert all(not like.endswith(".") for like in row.like), row.name


@pytest.mark.parametrize("domain", domains())
def test_a_cause_is_as_its_row_says(domain):
    """Of every row, in a part called left, with usual magnitudes that are all 2."""
    for row in rows(domain).values():
        shapes = (vars(shape).values() for shape in row.shapes.values())
        numbers = [row.said("typical", ANY), *(value for own in shapes for value in own)]
        names = re.findall(r"[a-z_]+", " ".join(map(str, [*numbers, row.form])))
        usual = dict.fromkeys(names, 2.0)
        effect = row.effect(lambda scene, size, run: scene, usual, ending="_of_left")
        stated = {
            "name": f"{row.name}_of_left",
            "family": row.family,
            "kind": row.kind,
            "unit": row.unit,
            "shown_unit": row.shown,
            "components": row.components,
            "signed": not row.said("one_sided", ANY),
            "smooth": not row.said("kink", ANY),
            "scanned": row.scanned,
            "tries": row.tries,
            "masks": tuple(f"{name}_of_left" for name in row.said("masks", ANY)),
            "also_looks_like": row.like,
            "typical": float(eval(str(row.said("typical", ANY)), dict(usual))),
        }
        assert {key: getattr(effect, key) for key in stated} == stated, row.name
        assert {*effect.shapes} == {f"{name}_of_{row.name}_of_left" for name in row.shapes}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"map": None}, "stated by map alone"),
        ({"add": "mass"}, "stated by map alone"),
        ({"typical": {"ode": 1.0}}, "what holds for any"),
        ({"words": "{nothing}"}, "cannot be filled in"),
        ({"at": "scene"}, "has no map"),
    ],
)
def test_a_row_that_cannot_act_is_refused(change, said):
    given = {"name": "x", "at": "command", "kind": "actuator", "map": "u", "typical": 0.1, **change}
    with pytest.raises(ValueError, match=said):
        Row.model_validate({k: v for k, v in given.items() if v is not None})


def test_the_page_of_all_causes_is_up_to_date():
    """Where this fails: python scripts/causes_page.py."""
    module = load_script("causes_page.py")
    kept = module.PAGE.read_text(encoding="utf-8").partition(module.MARK)[2]
    assert kept == f"\n{module.page()}"


def test_numbers_that_cannot_share_the_sizes_are_refused():
    given = {"name": "x", "at": "number", "kind": "force", "add": "mass", "components": ["y", "z"]}
    with pytest.raises(ValueError, match="1 numbers cannot share 2 sizes evenly"):
        Row.model_validate({**given, "typical": 0.1})
