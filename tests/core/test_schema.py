"""Blocks of YAML files: every mistake has a line with its path; YAML of strangers is bounded."""

import time
from typing import ClassVar

import pytest
from pydantic import Field, ValidationError

from diffsim.copter.design.design_file import load_design
from diffsim.core.errors import Mistakes
from diffsim.core.schema import FinitePart, Part, problem_lines, read_part
from diffsim.core.schema_numbers import Kilograms, Meters
from diffsim.core.yaml_text import load_yaml, read_yaml_file
from diffsim.data import load_study
from diffsim.identify.model_file import read_extended


class Mass(Part):
    mass: Kilograms = Field(description="Mass")
    label: str = Field("", description="Label")


class Cart(Part):
    masses: tuple[Mass, ...] = Field(min_length=1, description="Masses")
    length: Meters = Field(description="Length")


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
        sizes: tuple[Meters, ...]

    with pytest.raises(Mistakes) as caught:
        read_part(Rod, {"sizes": [1, float("nan"), float("inf")]}, "rod.yaml: ")
    assert str(caught.value).split("\n") == [
        "rod.yaml: sizes[1]: must be a finite number, got nan",
        "rod.yaml: sizes[2]: must be a finite number, got inf",
    ]


LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9)
)
BAD = {
    "a: [1\n": r"f.yaml, line 2: not YAML",
    "a: 1\nb: 2\na: 3\n": r"f.yaml, line 3: key 'a' stands twice",
    "a: 2001-99-99": r"f.yaml, line 1: no timestamp",
    "\na: &x [*x]": r"f.yaml, line 2: alias 'x' stands inside of itself",
    "[" * 3000: r"f.yaml, line 1: more than 50 levels",
    "a: *nope": r"undefined alias",
    "a: \x00": r"line 1: not YAML: character 0x0",
    "a: !!python/object/apply:os.system [x]": r"could not determine a constructor",
    "? [a]\n: 1": r"a key must be plain text",
    "x: " + "9" * 5000: r"line 1: no int",
    '\n"a\\ud800": 1': r"line 2: half of a character",
    "--- 1\n--- 2": r"another document",
    LAUGHS: r"line 6: more than 200,000 values, aliases counted",
    "a: " + "x" * 5_000_000: r"f.yaml: must have at most 5,000,000 letters, got 5,000,003",
}


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_what_is_refused_is_named_with_its_line(text):
    with pytest.raises(ValueError, match=BAD[text]):
        load_yaml(text, "f.yaml")


@pytest.mark.parametrize("read", [load_design, load_study, read_extended, read_yaml_file])
@pytest.mark.parametrize("text", [LAUGHS, "[" * 100_000, "parts: &p {a: *p}"], ids=range(3))
def test_every_reader_refuses_them_at_once(read, text, tmp_path):
    path = tmp_path / "given.yaml"
    path.write_text(text)
    begin = time.process_time()
    with pytest.raises(ValueError, match=r"given.yaml, line \d+: "):
        read(path)
    assert time.process_time() - begin < 2.0  # they hung, or ended by a RecursionError


def test_pairs_of_halves_are_characters():
    assert load_yaml(r'{"\ud83d\ude00": "\ud83e\udd16 x"}', "f") == {"\U0001f600": "\U0001f916 x"}


def test_merged_keys_and_shared_values_are_read():
    text = "base: {b: &b {<<: &a {x: 1, y: 0}, x: 2}}\nc: {<<: *b}\nd: [*b, *b]"
    both = {"x": 2, "y": 0}
    assert load_yaml(text, "f") == {"base": {"b": both}, "c": both, "d": [both, both]}


def test_bytes_that_are_no_text_are_named(tmp_path):
    path = tmp_path / "latin.yaml"
    path.write_bytes(b"a: 1\nname: caf\xe9\n")
    with pytest.raises(ValueError, match=r"latin.yaml, line 2: not UTF-8"):
        read_yaml_file(path)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "give one of a, b, got none"),
        ({"a": 0.0, "b": [1.0]}, "give one of a, b, got a and b"),
        ({"a": 0.0, "c": 1.0, "d": 2.0}, "give one of c, d, got c and d"),
        ({"a": 0.0, "b": [], "d": 2.0}, None),
    ],
)
def test_keys_that_exclude_each_other(given, said):
    class Choice(Part):
        a: float | None = None
        b: tuple[float, ...] = ()
        c: float | None = None
        d: float | None = None

        one_of: ClassVar = ("a", "b")
        at_most_one: ClassVar = ("c", "d")

    if said is None:
        assert read_part(Choice, given, "").a == 0.0
        return
    with pytest.raises(ValueError, match=said):
        read_part(Choice, given, "")
