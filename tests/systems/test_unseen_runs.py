"""What a test run holds changes nothing before the answer is frozen: no cause, prior or scale."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from diffsim.data import load_study
from diffsim.diagnose import diagnose
from diffsim.systems import published
from diffsim.systems.registry import setup_of
from tests.measured import data_folder
from tests.systems import test_flow_description as flow
from tests.systems import test_multicopter_description as copter
from tests.systems import test_rigid_body_description as rigid
from tests.systems.outside import scenes
from tests.systems.rod import test_rod_description as rod
from tests.systems.soft_body import described as soft
from tests.systems.toy_cart import TIME, cart_study

PUBLISHED = ("emps", "silicone_beam", "soft_tentacle", "starfish", "rotor_bench", "cube_toss")


def pulled_body():
    """A soft body with a tendon, pulled in three runs."""
    pulls = [np.linspace(0.0, most, 6) for most in (1e-3, 2e-3, 3e-3)]
    runs = tuple(
        soft.run_of(f"pull_{k}", np.arange(6.0), command={"pull_m": pull})
        for k, pull in enumerate(pulls)
    )
    return soft.study_of(soft.TENDON, runs)


MADE = {
    "ode": cart_study,
    "outside": scenes.recorded,
    "soft_body": pulled_body,
    "multicopter": copter.study,
    "rod": rod.study,
    "rigid_body": rigid.bouncing,
    "flow_network": lambda: flow.described(0),
}


def with_holes(values):
    """Every other sample missing."""
    out = np.array(values, dtype=float)
    out[::2] = np.nan
    return out


#: change of commands, of readings, of times
SPOILED = {
    "ten times": (lambda v: 10.0 * v, lambda v: 10.0 * v, lambda t: t),
    "negative": (lambda v: -v - 1.0, lambda v: -v - 1.0, lambda t: t),
    "not a number": (lambda v: v, with_holes, lambda t: t),
    "longer": (lambda v: v, lambda v: v, lambda t: 3.0 * t),
}


@cache
def study_of(name):
    """A study of the system by name, its last run for testing."""
    if name in PUBLISHED:
        data_folder({"rotor_bench": "rotor_bench"}.get(name, name))
        return load_study(Path(published.__file__).parent / f"{name}.yaml")
    made = MADE[name]()
    *others, last = made.runs
    return replace(made, runs=(*others, replace(last, use="test")))


def spoiled(study, how):
    """The study with other values, or times, in its test runs."""

    commands, readings, times = SPOILED[how]

    def changed(run):
        if run.use != "test":
            return run
        return replace(
            run,
            time_s=times(np.asarray(run.time_s)),
            command={k: commands(np.asarray(v, dtype=float)) for k, v in run.command.items()},
            measured=readings(run.measured),
        )

    return replace(study, runs=tuple(changed(run) for run in study.runs))


def known_before(setup, study):
    """All that a search starts from: causes with their sizes, priors, scales, effort.

    A test run's own start is no prior of the search: it is fitted to that run after the answer.
    """
    own = tuple(f"@{run.name}" for run in study.test_runs)
    causes = [
        (e.name, e.form, e.family, e.kind, e.unit, e.typical, e.components) for e in setup.effects
    ]
    unknowns = [
        {k: np.asarray(v).tolist() for k, v in vars(u).items() if isinstance(v, (str, float, int))}
        for u in setup.unknowns
    ]
    base = [
        (p.name, p.value, p.sd, p.lower, p.upper, p.step)
        for p in setup.model.base
        if not p.name.endswith(own)
    ]
    return causes, unknowns, base, dict(setup.model.frame or {}), setup.settings


@pytest.mark.parametrize("how", SPOILED)
@pytest.mark.parametrize("name", [*MADE, *PUBLISHED])
def test_a_test_run_gives_no_cause_and_no_prior(name, how):
    study = study_of(name)
    assert study.test_runs and study.without_tests().runs
    before = known_before(setup_of(study), study)
    assert before[0], "a system without causes would tell nothing"
    assert known_before(setup_of(spoiled(study, how)), study) == before


def test_the_answer_is_the_same_to_the_bit():
    def answer(study):
        setup = setup_of(study)
        report = diagnose(
            study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns,
            settings=setup.settings,
        )  # fmt: skip
        # test runs may take back, and say so: what the answer was before is kept
        frozen = report.before_test
        statuses = {c.name: c.status for c in report.causes}
        statuses |= {} if frozen is None else frozen.statuses
        verdict = report.verdict if frozen is None else frozen.verdict
        return verdict, [(c.name, c.probability, statuses[c.name]) for c in report.causes]

    study = cart_study(drive=lambda u: np.sign(u) * np.maximum(np.abs(u) - 1.0, 0.0))
    study = replace(study, runs=tuple(r for r in study.runs if r.name in ("step", "sweep", "saw")))
    assert answer(study) == answer(spoiled(study, "ten times"))
    assert len(TIME) == len(study.runs[0].time_s)
