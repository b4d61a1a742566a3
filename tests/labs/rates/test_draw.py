"""A case follows from master seed, domain and number alone; a third of each kind."""

from collections import Counter
from functools import cache

import numpy as np
import pytest
import torch

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.data import load_study
from diffsim.diagnose.judge.records import EFFECT
from diffsim.systems.registry import setup_of
from labs.rates import draw as draw_module
from labs.rates.case import (
    QUICK,
    case_inputs,
    denied_names,
    diagnosed,
    make,
    row_of,
    truth_of,
    write_study,
)
from labs.rates.domains import DOMAINS, missing_package
from labs.rates.draw import KINDS, LAMBDAS, Draw, draw, recordable
from labs.rates.rig import Cause, drawn_direction
from labs.rates.troubles import COLOR, TAILS
from labs.systems import setup_of as setup_of_laboratory
from labs.virtual import LABS
from tests.diagnose.discover.answers import no_laws

DESCRIBED = [
    (domain, rig)
    for domain, rigs in DOMAINS.items()
    for rig in rigs
    if rig.setup_file is None and missing_package(rig) is None
]
# PyElastica compiles itself in each process: 20 CPU s
COSTS = {"elastica": pytest.mark.cpu(40)}
EACH_RIG = pytest.mark.parametrize(
    ("domain", "rig"),
    [pytest.param(*d, marks=COSTS.get(getattr(d[1], "package", ""), ())) for d in DESCRIBED],
    ids=[rig.name for _, rig in DESCRIBED],
)


@cache
def sound(name):
    """A rig's recordings with nothing hidden."""
    return next(rig for _, rig in DESCRIBED if rig.name == name).record(5, {}, "")


def test_a_case_is_drawn_from_its_place_alone():
    """Whatever was drawn before, and another master seed gives another one."""
    again = [draw(7, "toy", 5) for _ in range(2)]
    assert again[0] == again[1]
    draw(7, "toy", 4)
    assert draw(7, "toy", 5) == again[0]
    assert draw(8, "toy", 5).seed != again[0].seed
    assert draw(7, "ode", 5).seed != again[0].seed


@pytest.mark.parametrize("domain", DOMAINS)
def test_a_third_of_each_kind_over_the_whole_range(domain):
    cases = [draw(1, domain, k) for k in range(300)]
    assert Counter(c.kind for c in cases) == dict.fromkeys(KINDS, 100)
    wanted = [c.wanted for c in cases if c.hidden]
    low, high = LAMBDAS
    assert low < min(wanted) < 1.2 * low and 0.8 * high < max(wanted) < high
    assert {c.rig.name for c in cases} == {rig.name for rig in DOMAINS[domain]}
    for case in cases:
        assert bool(case.hidden) == (case.kind != "null")
        if case.kind == "library":
            assert case.cause.known
        if case.hidden:
            assert np.linalg.norm(case.direction) == pytest.approx(1.0)
            assert case.cause.signed or min(case.direction) >= 0.0


def test_rigs_that_cannot_be_recorded_are_left_out(monkeypatch):
    """Cases of the others keep their numbers."""
    left = {"pendulum": "a_package"}
    monkeypatch.setattr(draw_module, "missing_package", lambda rig: left.get(rig.name))
    found = recordable(3, "ode", 10)
    assert len(found) == 10
    assert all(draw(3, "ode", k).rig.name != "pendulum" for k in found)
    skipped = set(range(max(found))) - set(found)
    assert skipped and all(draw(3, "ode", k).rig.name == "pendulum" for k in skipped)
    monkeypatch.setattr(draw_module, "missing_package", lambda rig: "a_package")
    assert recordable(3, "ode", 10) == []


def test_directions_have_one_place_and_signs_where_they_should():
    rng = np.random.default_rng(0)
    places = [drawn_direction(rng, Cause(1.0, True, 4, one_place=True)) for _ in range(50)]
    assert {sum(x != 0.0 for x in p) for p in places} == {1}
    assert {min(p) < 0.0 for p in places} == {True, False}
    assert all(x >= 0.0 for _ in range(20) for x in drawn_direction(rng, Cause(1.0, False, 3)))


@EACH_RIG
def test_libraries_hold_what_rigs_hide(domain, rig):
    """By every name, but for what is in no library."""
    known = {e.name for e in setup_of(sound(rig.name).study).effects}
    for name, cause in rig.causes.items():
        own = {*(cause.names or (name,))}
        assert own <= known if cause.known else not own & known, (name, sorted(known))


@EACH_RIG
def test_only_what_is_hidden_differs(domain, rig):
    """Recordings of one seed: the same noise and commands, and nothing of a size of zero."""
    plain = sound(rig.name)
    name, cause = next(iter(rig.causes.items()))
    changed = rig.record(5, {name: (cause.typical,) * cause.components}, "")
    if domain != "flight":  # there a controller answers what is hidden
        for a, b in zip(plain.study.runs, changed.study.runs, strict=True):
            assert all(np.array_equal(a.command[k], b.command[k]) for k in a.command)
    noise = [
        np.concatenate([(n.measured - e.measured).ravel() for n, e in pairs])
        for pairs in (list(zip(r.study.runs, r.clean.runs, strict=True)) for r in (plain, changed))
    ]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-9)
    assert any(
        not np.allclose(a.measured, c.measured, rtol=1e-12)
        for a, c in zip(plain.clean.runs, changed.clean.runs, strict=True)
    )


def at_truth(model, base):
    """Coordinates of the true base parameters, as far as they are known."""
    q = model.at_prior()
    for i, p in enumerate(model.base):
        if p.name in base:
            true = base[p.name]
            q[i] = np.log(true / p.value) / p.sd if p.log else (true - p.value) / p.sd
    return q


FAST = ("propeller", "load_cell")


@pytest.mark.parametrize(
    ("domain", "rig"),
    [pytest.param(*d, marks=() if d[1].name in FAST else pytest.mark.slow) for d in DESCRIBED],
    ids=[r.name for _, r in DESCRIBED],
)
def test_what_is_hidden_is_the_librarys_cause_at_its_size(domain, rig):
    """A tenth of what a cause does is left by the model with it, at the true numbers."""
    plain = rig.record(3, {}, "")
    made = setup_of(plain.study)
    effects = {e.name: e for e in made.effects}
    q, sd = at_truth(made.model, plain.base), np.array([c.sd for c in plain.study.channels])

    def left(runs, sizes=None):
        with torch.no_grad():
            return [(made.model.predict(r, q, sizes).numpy() - r.measured) / sd for r in runs]

    for name, cause in rig.causes.items():
        if not (cause.known and cause.sized):
            continue
        size = (cause.typical,) * cause.components
        runs = rig.record(3, {name: size}, "").clean.fit_runs[:3]
        effect = effects[(cause.names or (name,))[0]]
        off = left(runs, {effect: torch.tensor(size, dtype=torch.float64)})
        change = [
            (h.measured - p.measured) / sd for h, p in zip(runs, plain.clean.runs, strict=False)
        ]
        before = left(plain.clean.fit_runs[:3])
        rest = np.concatenate([(a - b).ravel() for a, b in zip(off, before, strict=True)])
        assert np.linalg.norm(rest) <= 0.1 * np.linalg.norm(np.concatenate(change)), name


def toy(kind, hidden, denies="row"):
    rig = next(r for r in DOMAINS["toy"] if hidden in r.causes)
    return Draw(rig, kind, hidden, (1.0,), 8.0, "", denies, 3)


def test_what_is_denied_is_really_absent():
    """The cause, all of its row, and where it says so all of its family; nothing else."""
    case = toy("denied", "dry_friction")
    effects = setup_of(case.rig.record(3, {}, "").study).effects
    truth = truth_of(case, 0.1, effects)
    assert denied_names(case, truth, effects) == ("dry_friction",)
    family = toy("denied", "dry_friction", "family")
    without = denied_names(family, truth, effects)
    (own,) = (e.family for e in effects if e.name == "dry_friction")
    assert set(without) == {e.name for e in effects if e.family == own}
    assert denied_names(toy("library", "dry_friction"), truth, effects) == ()
    # a name that says the same is denied, too
    offset = toy("denied", "constant_force")
    truth = truth_of(offset, 0.1, effects)
    assert set(denied_names(offset, truth, effects)) == {"constant_force", "command_offset"}


def test_rows_are_told_from_places():
    assert row_of("dry_friction_at_load") == "dry_friction" == row_of("dry_friction")
    assert row_of("weak_rotor_2") == "weak_rotor"
    assert row_of("sensor_scale_of_velocity") == "sensor_scale"


@pytest.mark.parametrize("system", [pytest.param("copter", marks=pytest.mark.slow), "stokes"])
def test_laboratories_call_causes_as_libraries_do(system):
    lab = LABS[system]()
    rig = next(r for rs in DOMAINS.values() for r in rs if getattr(r, "lab", None) is LABS[system])
    known = {e.name for e in setup_of_laboratory(lab(1)).effects}
    for name, cause in rig.causes.items():
        places = {f"{name}_{k + 1}" for k in range(cause.components)}
        assert not cause.known or name in known or places <= known, (name, sorted(known))


@pytest.mark.parametrize("trouble", [COLOR, TAILS])
def test_a_sound_bench_is_sound_whatever_the_noise(trouble, tmp_path):
    """Sweeps have no repeats: noise that remembers a sample was an unknown drift."""
    stand = DOMAINS["bench"][1]
    for seed in range(4):
        write_study(stand.record(seed, {}, trouble), folder := tmp_path / f"{trouble}_{seed}")
        made = {"setup_file": None, "without": ()}
        report = diagnosed(case_inputs(made, folder, QUICK))
        assert report.verdict == "none", (seed, report.headline)


@pytest.mark.parametrize(
    ("hidden", "size", "lacks", "named"),
    [
        ("exponent_of_thrust", 0.016, "law_of_thrust", "zero_of_thrust"),
        ("run_drift_of_thrust", 0.05, "drift_of_thrust", "hysteresis_loop_of_thrust"),
        ("zero_of_thrust", 0.6, "", "zero_of_thrust"),
        ("hysteresis_of_thrust", 0.008, "", "hysteresis_of_thrust"),
    ],
)
def test_a_law_is_certain_only_where_no_other_law_of_the_same_would_do(
    hidden, size, lacks, named, tmp_path
):
    """A power that nobody listed was a zero, for certain; a drift a loop of hysteresis."""
    stand = DOMAINS["bench"][1]
    write_study(stand.record(3, {hidden: (size,)}, ""), tmp_path / "study")
    effects = inputs_of(load_study(tmp_path / "study"), seed=0).setup.effects
    made = {"setup_file": None, "without": [e.name for e in effects if e.family == lacks]}
    with no_laws():
        report = diagnosed(case_inputs(made, tmp_path / "study", QUICK))
    listed = [row for row in report.causes if row.origin == EFFECT]
    certain = [row.name for row in listed if row.status == "certain"]
    assert certain == ([] if lacks else [named])
    assert named in {row.name for row in report.causes if row.status != "refuted"}


def test_the_study_folder_does_not_name_what_is_hidden(tmp_path):
    """Nor the seed, nor the rig's domain; and it is made the same again."""
    item = {"master": 5, "domain": "bench", "index": 1}
    made = [make(item, tmp_path / name) for name in ("once", "again")]
    assert {**made[0], "making_cpu_s": 0.0} == {**made[1], "making_cpu_s": 0.0}
    case = draw(5, "bench", 1)
    for once in sorted((tmp_path / "once").iterdir()):
        text = once.read_text()
        assert text == (tmp_path / "again" / once.name).read_text()
        assert case.hidden not in text and str(case.seed) not in text
    assert load_study(tmp_path / "once").name == "case"
