"""The listing of causes is the same again, and a cause that is moved a little moves it."""

from dataclasses import replace

import pytest

from benchmarks.listed_causes import STEPS, listing
from benchmarks.listed_studies import sources

STUDIES = ("rates/load_cell", "stranger/ladder")


def lines(study, setup):
    return list(listing(study, setup, STEPS))


@pytest.mark.parametrize("name", STUDIES)
def test_a_listing_is_the_same_again_and_shows_a_move(name):
    study, setup = sources()[name]()
    before, again = lines(study, setup), lines(*sources()[name]())
    assert again == before
    first, *others = setup.effects

    def moved(**changes):
        own = replace(setup, effects=(replace(first, **changes), *others))
        return [a for a, b in zip(lines(study, own), before, strict=True) if a != b]

    assert any(f"{first.name}/typical" in line for line in moved(typical=first.typical * 1.001))
    stronger = moved(apply=lambda scene, size, run: first.apply(scene, size * (1 + 1e-9), run))
    assert [line.split(" = ")[0] for line in stronger] == [f"{first.name}/acts/change"]
