"""One unit and one family per name of an effect, in all libraries."""

from __future__ import annotations

import re
from collections import defaultdict

import pytest

from diffsim.causes.catalogue import rows_in_order
from diffsim.causes.listing import list_causes
from diffsim.causes.plant import Plant
from diffsim.causes.scales import Scales
from diffsim.core.units import factor
from diffsim.identify import Effect, coarse
from diffsim.identify.numerics import REFINEMENTS
from diffsim.systems.multicopter import copter_plant, unknown_wrench
from diffsim.systems.registry import setup_of
from diffsim.systems.soft_body import unknown_force
from labs.systems import copter, network
from labs.systems.beam_causes import causes
from labs.virtual import NetworkLab
from tests.systems.rod.test_rod_description import study as rod_study
from tests.systems.soft_body.causes import CAUSES
from tests.systems.test_flow_device import DEVICES, causes_of
from tests.systems.toy_cart import cart_study

DESCRIBED = ("speeds", "lags_speed", "radius", "battery", "sees_position", *copter.FACTS[-3:])


def rigid_bodies(kind: str) -> tuple[Effect, ...]:
    """All causes of a table that suit some body."""
    rows = [row for _, row in rows_in_order(kind)]
    return list_causes(
        Plant(
            kind=kind,
            scales=Scales.of_runs(rod_study()),
            channels=(),
            numbers=tuple(name for row in rows for name in row.add),
            facts={fact: True for row in rows for fact in row.when},
            magnitudes={"lift": 0.05, "drag": 0.02},
        )
    )


@pytest.fixture(scope="module")
def libraries() -> dict[str, tuple[Effect, ...]]:
    return {
        "soft_body": tuple(CAUSES.values()),
        "multicopter": copter.causes(6),
        "described multicopter": list_causes(copter_plant(4, 1.0, 0.2, DESCRIBED)),
        "flow_device": causes_of(DEVICES["pumps"]),
        "flow_network": network.setup(NetworkLab()(1)).effects,
        "laboratory beam": causes(1.0),
        "balls": rigid_bodies("balls"),
        "ode": setup_of(cart_study()).effects,
        "toss": rigid_bodies("toss"),
        "rod": setup_of(rod_study()).effects,
        "unknown": (
            unknown_wrench(3, 1.0),
            unknown_force(3, 1.0),
        ),
        "numerical": tuple(coarse(name, finer) for name, finer in REFINEMENTS.items()),
    }


def test_a_name_has_one_unit_and_one_family(libraries):
    known = defaultdict(set)
    for effects in libraries.values():
        for effect in effects:
            known[effect.name].add((effect.unit, effect.family))
    assert len(known) > 100
    assert {name: found for name, found in known.items() if len(found) > 1} == {}


def test_names_are_distinct_within_a_library(libraries):
    for effects in libraries.values():
        assert len({e.name for e in effects}) == len(effects)


def test_names_families_and_units_are_spelled_one_way(libraries):
    for effects in libraries.values():
        for e in effects:
            assert re.fullmatch(r"[a-z][a-z0-9_]*", e.name), e.name
            assert re.fullmatch(r"[a-z][a-z0-9_]*", e.family), e.family
            assert "centre" not in e.name + e.family  # American spelling
            # powers with ^, as in m/s^2
            assert not re.search(r"[a-z][0-9]", e.unit), (e.name, e.unit)
            assert len(set(e.components)) == len(e.components) > 0


def test_effects_cannot_be_changed(libraries):
    with pytest.raises(AttributeError):
        libraries["balls"][0].typical = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="kind must be one of"):
        Effect(name="a", family="a", kind="forces", unit="-", typical=1.0, apply=lambda *_: None)


def test_a_unit_in_which_a_size_is_read_is_one_of_its_quantity(libraries):
    for effect in (e for effects in libraries.values() for e in effects):
        if effect.shown_unit is not None and effect.shown_times is None:
            assert factor(effect.unit, effect.shown_unit) > 0.0  # raises where none leads there
