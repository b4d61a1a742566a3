"""A mistake in the description of a study is told with its place in the file, by every kind.

``mistakes.yaml`` beside a study of ``tests/studies`` lists keys of the model that are replaced, and
what is said then; between parts of it that stand in this order is ``...``.
"""

import re
from dataclasses import replace
from functools import cache

import pytest
import yaml

from diffsim.systems.registry import setup_of
from tests.studies import HERE, NAMES, study_of

MISTAKES = [
    pytest.param(path.parent.name, one["change"], one["says"], id=f"{path.parent.name}-{k}")
    for path in sorted(HERE.glob("*/mistakes.yaml"))
    for k, one in enumerate(yaml.safe_load(path.read_text("utf-8")))
]
read = cache(study_of)


@pytest.mark.parametrize(("name", "change", "says"), MISTAKES)
def test_a_mistake_is_told_with_its_place_in_the_file(name, change, says):
    study = read(name)
    with pytest.raises(ValueError) as refused:
        setup_of(replace(study, model={**study.model, **change}))
    told = str(refused.value)
    assert re.match(
        rf"({re.escape(str(HERE / name))}/study.yaml: |error: )?(model|effects)\b", told
    )
    parts = map(re.escape, says.split(" ... "))
    assert re.search(".*".join(parts), told), told


def test_every_kind_is_asked():
    asked = {read(str(one.values[0])).system for one in MISTAKES}
    assert asked == {read(name).system for name in NAMES}
