"""Blocks of YAML files: every mistake has a line with its path."""

from __future__ import annotations

import pytest
from pydantic import Field, ValidationError

from diffsim.core.schema import Part, number, problem_lines


class Mass(Part):
    mass: number("kg") = Field(description="Mass")
    label: str = Field("", description="Label")


class Cart(Part):
    masses: tuple[Mass, ...] = Field(description="Masses")
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
