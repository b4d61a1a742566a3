"""Every kind of system keeps the contract of ``kinds.py``, in the studies of ``tests/studies``."""

from collections import defaultdict
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from diffsim.data import load_study
from diffsim.identify import Effect
from diffsim.systems import published
from tests.diagnose.discover.answers import answer
from tests.measured import data_folder
from tests.studies import NAMES, study_of
from tests.systems import kinds
from tests.systems.kinds import Ready
from tests.systems.toy_cart import cart_study, described

PUBLISHED = ("emps", "silicone_beam", "soft_tentacle", "starfish", "rotor_bench", "cube_toss")
QUICK = ("emps", "rotor_bench", "cube_toss", "soft_tentacle")
#: what a study cannot show, and why
SILENT = {
    "rod_poses": {"twist_stiffness": "its poses lie in a plane"},
    "rod_in_time": {
        "twist_stiffness": "its poses lie in a plane",
        **dict.fromkeys(
            ("rate_limit", "rate_limit_of_left", "rate_limit_of_right"),
            "its limit is ten times the reach in a second",
        ),
    },
    "toss": {
        **dict.fromkeys(
            ("ground_slope", "half_width", "contact_time", "restitution_slope"),
            "it never touches the ground",
        ),
        **dict.fromkeys(("tangential_rebound", "friction_slope"), "it never touches the ground"),
        "tracking_smoothing": "it smooths touches",
        "moment_of_inertia": "of all axes alike: a body that turns freely does not show it",
    },
    "ode_stores": {"rate_limit": "its limit is ten times the reach in a second"},
    "flow_in_time": {"rate_limit": "its limit is ten times the reach in a second"},
    "ball": dict.fromkeys(("rolling_resistance", "tangential_rebound"), "it never spins"),
}
#: statements that a kind does not keep, and why
NOT_KEPT = {
    ("toss", "formulas_are_as_written"): "its flights begin where its record says",
    **{
        (name, "priors_are_as_stated"): "a stated resistance holds for the stated viscosity"
        for name in ("flow_in_time", "flow_levels")
    },
    ("soft_swung", "clocks_may_begin_at_any_second"): "its start says 0 s of the clock",
    ("outside", "slopes_are_those_of_differences"): "a simulator of one's own has no slopes",
    ("multicopter", "slopes_are_those_of_differences"): "its windows begin where its record says",
}


@cache
def ready(name):
    return Ready(study_of(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_cause_is_nothing_at_size_zero_and_something_at_its_usual_size(name):
    kinds.causes_act(ready(name), tuple(SILENT.get(name, {})))


@pytest.mark.parametrize(
    ("name", "statement"),
    [
        (name, statement)
        for name in NAMES
        for statement in kinds.STATEMENTS
        if (name, statement.__name__) not in NOT_KEPT
    ],
    ids=lambda v: getattr(v, "__name__", v),
)
def test_every_kind_keeps_its_contract(name, statement):
    statement(ready(name))


def published_set(name):
    data_folder(name)
    return Ready(load_study(Path(published.__file__).parent / f"{name}.yaml"))


@pytest.mark.story
@pytest.mark.parametrize("name", PUBLISHED)
def test_test_runs_of_published_sets_change_nothing(name):
    kinds.test_runs_change_nothing(published_set(name))


@pytest.mark.story
@pytest.mark.parametrize("name", QUICK)
def test_answers_of_published_sets_do_not_depend_on_what_was_asked_before(name):
    kinds.answers_do_not_depend_on_what_was_asked_before(published_set(name))


def test_effects_cannot_be_changed():
    with pytest.raises(AttributeError):
        ready("bench").setup.effects[0].typical = 2.0
    with pytest.raises(ValueError, match="kind must be one of"):
        Effect(name="a", family="a", kind="forces", unit="-", typical=1.0, apply=lambda *_: None)


def test_a_name_has_one_unit_and_one_family_in_all_kinds():
    known = defaultdict(set)
    for effect in (e for name in NAMES for e in ready(name).setup.effects):
        known[effect.name].add((effect.unit, effect.family))
    assert len(known) > 100
    assert {name: found for name, found in known.items() if len(found) > 1} == {}


def test_the_answer_is_the_same_to_the_bit_whatever_a_test_run_holds():
    def told(study):
        report = answer(study)
        # test runs may take back, and say so: what the answer was before is kept
        frozen = report.before_test
        statuses = {c.name: c.status for c in report.causes}
        statuses |= {} if frozen is None else frozen.statuses
        verdict = report.verdict if frozen is None else frozen.verdict
        # what was taken back stands further down
        return verdict, sorted((c.name, c.probability, statuses[c.name]) for c in report.causes)

    few = {"only": ["dead_band", "dry_friction", "command_gain", "delay", "saturation", "lag"]}
    dead = lambda u: np.sign(u) * np.maximum(np.abs(u) - 1.0, 0.0)  # noqa: E731
    study = cart_study(drive=dead, model=described(effects=few))
    study = replace(study, runs=tuple(r for r in study.runs if r.name in ("step", "sweep", "saw")))
    assert told(study) == told(kinds.spoiled(study, "larger and longer"))
