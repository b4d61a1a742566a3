"""Blocks of YAML files: every mistake has a line with its path."""

from __future__ import annotations

import pytest
from pydantic import Field, ValidationError

from diffsim.core.errors import Mistakes
from diffsim.core.schema import FinitePart, Part, number, problem_lines, read_part


class Mass(Part):
    mass: number("kg") = Field(description="Mass")
    label: str = Field("", description="Label")


class Cart(Part):
    masses: tuple[Mass, ...] = Field(min_length=1, description="Masses")
    length: number("m") = Field(description="Length")


def lines(content) -> list[str]:
    with pytest.raises(ValidationError) as caught:
        Cart.model_validate(content)
    return problem_lines("study.yaml: model", caught.value)


def test_units_are_converted():
    cart = Cart.model_validate({"masses": [{"mass": "200 g"}], "length": 0.5})
    assert (cart.masses[0].mass, cart.length) == (0.2, 0.5)


def test_every_mistake_has_a_line_with_its_path():
    first, second, third = lines(
        {"masses": [{"mass": "2 mm"}, {"mass": 1.0, "lable": "a"}], "length": "far"}
    )
    assert first.startswith("study.yaml: model.masses[0].mass: unit 'mm' is no unit of")
    assert second.startswith("study.yaml: model.masses[1]: no key 'lable' here; did you mean 'la")
    assert (
        third == "study.yaml: model.length: must be a number in m, or one with its unit, got 'far'"
    )


def test_entries_that_are_wrong_are_not_missing():
    assert lines({"masses": [], "length": 1}) == [
        "study.yaml: model.masses: must have 1 or more entries"
    ]
    (only,) = lines({"masses": [{"mass": "far"}], "length": 1})
    assert only.startswith("study.yaml: model.masses[0].mass: must be a number in kg")


def test_numbers_of_a_finite_block_are_finite():
    class Rod(FinitePart):
        sizes: tuple[number("m"), ...]

    with pytest.raises(Mistakes) as caught:
        read_part(Rod, {"sizes": [1, float("nan"), float("inf")]}, "rod.yaml: ")
    assert str(caught.value).split("\n") == [
        "rod.yaml: sizes[1]: must be a finite number, got nan",
        "rod.yaml: sizes[2]: must be a finite number, got inf",
    ]
