"""Laws against causes of the library: what they may cost, which are weighed, what stands."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from diffsim.core.units import factor, to_si
from diffsim.diagnose import diagnosis
from diffsim.diagnose.discover import forms, stage
from diffsim.diagnose.discover.screen import Candidate, bumps
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.records import CERTAIN, LIKELY
from diffsim.diagnose.say.assemble import doubted
from diffsim.diagnose.say.headline import headline
from diffsim.diagnose.say.wording import sentences
from diffsim.identify.effort import SearchSettings
from diffsim.identify.law import Entry, Law, Variable
from diffsim.systems.ode.law_port import LIGHTLY, SWINGING
from tests.diagnose.discover.answers import found
from tests.diagnose.discover.turntable import turntable_study

LAW, MIMIC = "law_of_angle_at_shaft", "square_drag_at_shaft"
GIVEN = 1000.0
GAIN = Gain(value=0.9, low=0.8, high=1.0, excess=10.0, num_blocks=20, fall=5.0)


def answer_of(best, *rivals, verdict="named", gain=GAIN, of_law=GAIN):
    causes = [SimpleNamespace(name=LAW, gain=of_law), SimpleNamespace(name=MIMIC, gain=None)]
    return SimpleNamespace(
        verdict=verdict, best_names=best, rivals=rivals, gain=gain, causes=causes
    )


def gaining(value):
    return replace(GAIN, value=value)


BEFORE = answer_of((MIMIC,))


@pytest.mark.parametrize(
    ("again", "takes_over"),
    [
        (answer_of((LAW,), gain=gaining(0.91)), True),
        (answer_of((LAW,), (LAW, MIMIC), gain=gaining(0.91)), True),
        (answer_of((LAW,), (MIMIC,), gain=gaining(0.91)), False),  # within the odds
        (answer_of((LAW,), gain=gaining(0.89)), False),  # unseen runs prefer the causes
        (answer_of((LAW,), (MIMIC,), gain=replace(GAIN, value=1.0, low=0.95)), True),
        (answer_of((LAW,), gain=gaining(0.91), of_law=replace(GAIN, fall=-0.1)), False),
        (answer_of((), verdict="unknown"), False),
    ],
)
def test_a_law_takes_the_place_of_causes_that_lose_to_it(again, takes_over):
    """By the evidence of one search, and by unseen runs."""
    assert diagnosis._may_take_over(again, BEFORE, {LAW}) is takes_over


def test_a_law_stands_where_nothing_was_named():
    before = answer_of((), verdict="unknown", gain=None)
    assert diagnosis._may_take_over(answer_of((LAW,), gain=gaining(0.1)), before, {LAW})


@pytest.mark.parametrize(
    ("named", "nats", "takes_over"),
    [
        (LAW, (50.0, 101.0), True),
        # a hull's square drag left noise; the search with laws never came to it, and told a power
        (LAW, (50.0, 99.0), False),
        # causes of the library, come to from a law: a gimbal's weight and dry friction
        (MIMIC, (105.0, 50.0), True),
        (MIMIC, (103.0, 50.0), False),
    ],
)
def test_what_a_search_with_laws_found_is_held_against_the_best_set_before(
    monkeypatch, named, nats, takes_over
):
    noise = SimpleNamespace(whitener=SimpleNamespace(is_like=lambda other: True))
    search = SimpleNamespace(
        nats=lambda hypothesis: 100.0,
        null=SimpleNamespace(noise=noise),
        wide=SimpleNamespace(model=SimpleNamespace(simulations=None)),
    )
    before = SimpleNamespace(frozen=BEFORE, search=search, best=frozenset({0}))
    again = SimpleNamespace(
        frozen=answer_of((named,), gain=gaining(0.91)),
        found=search,
        search=search,
        nats_with=lambda laws: nats,
    )
    setup = SimpleNamespace(model=SimpleNamespace(), effects=(), unknowns=())
    port = SimpleNamespace(setup_with=lambda blocks: setup, block=lambda law: law)
    laws = SimpleNamespace(laws=(SimpleNamespace(name=LAW),), most_nats=-np.inf, begins=())
    monkeypatch.setattr(diagnosis, "_answer", lambda *asked: again)
    monkeypatch.setattr(diagnosis, "_doubted_beside", lambda answer, *nats: answer)
    given: Any = (None, before, port, laws, diagnosis._LawBudget(1.0, None, is_short=False))
    assert diagnosis._with_laws(*given)[0] is (again if takes_over else before)


@dataclass(frozen=True)
class Gated:
    verdict: str
    gates: tuple = ()
    is_full: bool = False


@pytest.mark.parametrize(
    ("verdict", "steps", "is_weighed"),
    [("named", 7.0, True), ("named", 9.0, False), ("unknown", 9.0, True)],
)
def test_no_search_weighs_laws_beside_named_causes_once_all_is_spent(
    monkeypatch, verdict, steps, is_weighed
):
    """A beam's search with laws had one step, took 41 million, and told nothing."""
    search = SimpleNamespace(
        nats=lambda hypothesis: 100.0,
        steps=steps,
        settings=SearchSettings(refit_steps=10.0),
        wide=SimpleNamespace(model=SimpleNamespace(simulations=None)),
    )
    before = diagnosis._Answer(Gated(verdict), search, frozenset({0}))  # type: ignore[arg-type]
    best = SimpleNamespace(problem=SimpleNamespace(effects=()))
    frozen = SimpleNamespace(verdict="none", best_names=(), best=best)
    again = SimpleNamespace(frozen=frozen, found=None)
    setup = SimpleNamespace(model=SimpleNamespace(), effects=(), unknowns=())
    port = SimpleNamespace(setup_with=lambda blocks: setup, block=lambda law: law)
    laws = SimpleNamespace(laws=(SimpleNamespace(name=LAW),), most_nats=-np.inf, begins=())
    asked = SimpleNamespace(within=lambda steps: asked)
    monkeypatch.setattr(diagnosis, "_answer", lambda *asked: again)
    monkeypatch.setattr(diagnosis, "_doubted_beside", lambda answer, *nats: answer)
    monkeypatch.setattr(diagnosis, "doubted", lambda frozen, why: frozen)
    budget = diagnosis._LawBudget(1.0, 8.0, is_short=False)
    given: Any = (asked, before, port, laws, budget)
    answer, searched = diagnosis._with_laws(*given)
    assert (searched is not None) is is_weighed
    notes = [gate.note for gate in answer.frozen.gates]
    assert any("found, but not weighed" in note for note in notes) is not is_weighed


def spending(share, records=1e3, **settings):
    """An answer that spent a share of what was given, which is worth so many simulations."""
    search = SimpleNamespace(
        steps=5.0 + share * GIVEN,
        settings=SearchSettings(refit_steps=GIVEN, **settings),
        wide=SimpleNamespace(cost=lambda: GIVEN / records),
    )
    return SimpleNamespace(found=search, search=search, kept=0.0)


@pytest.mark.parametrize(("spent", "is_short"), [(0.2, False), (0.9, True), (1.2, True)])
def test_laws_with_a_budget_of_their_own_have_it_whatever_was_spent(spent, is_short):
    """A cogging of 515 nats was screened and not fitted: little was left of the budget."""
    budget = diagnosis._budget_of_laws(spending(spent, law_steps=2.0 * GIVEN), 5)
    assert budget == diagnosis._LawBudget(2.0 * GIVEN, None, is_short)


def test_beside_a_law_all_causes_that_act_where_it_does_are_asked_again():
    """A gimbal's dry friction in pan was told as a memory of its speed: weight off the tilt axis
    had hidden it from the first search."""
    names = ["dry_friction_at_pan", "play_at_pan", "dry_friction_at_tilt", "command_gain", "lag"]
    nats = {(): 0.0, (3,): 90.0, (4,): 88.0}
    search = SimpleNamespace(
        fits=dict.fromkeys(nats),
        nats=lambda hypothesis: nats[tuple(hypothesis.effects)],
        settings=SearchSettings(),
        wide=SimpleNamespace(effects=[SimpleNamespace(name=name) for name in names]),
    )
    answer = SimpleNamespace(search=search, best=(3,))
    near = diagnosis._names_near_best(answer)
    assert near == {"command_gain", "lag"}
    asked = diagnosis._names_near_best(answer, {"pan", "angle"})
    assert asked == near | {"dry_friction_at_pan", "play_at_pan"}


def test_laws_that_share_a_budget_have_what_is_left_of_it():
    budget = diagnosis._budget_of_laws(spending(0.2, law_steps=None), 5)
    # half to find them, the rest for the search with them
    assert budget == diagnosis._LawBudget(pytest.approx(0.4 * GIVEN), 5 + GIVEN, False)
    short = diagnosis._budget_of_laws(spending(0.6, law_steps=None), 5)
    assert short == diagnosis._LawBudget(pytest.approx(0.2 * GIVEN), 5 + GIVEN, True)
    assert diagnosis._budget_of_laws(spending(0.85, law_steps=None), 5).steps == 0.0
    # what was kept for them is theirs, whatever causes have spent
    answer = spending(1.5, law_steps=None)
    answer.kept = GIVEN
    assert diagnosis._budget_of_laws(answer, 5).steps == pytest.approx(0.5 * GIVEN)
    # but not where it lasts for a law's fit or two: a silicone beam's took 170 CPU s
    dear = spending(2.5, records=100.0, law_steps=None)
    dear.kept = GIVEN
    assert diagnosis._budget_of_laws(dear, 5).steps == 0.0


@pytest.mark.parametrize(
    ("verdict", "left", "has_room"),
    [("named", 0.96, True), ("named", 0.25, False), ("unknown", 0.25, True), ("none", 1.0, False)],
)
def test_no_law_is_looked_for_in_what_the_study_says_to_be_noise(verdict, left, has_room):
    """A law took the place of a chamber's ballooning: 0.01 of the noise sd less was left by it."""
    frozen = SimpleNamespace(verdict=verdict, left=left, gates=())
    answer = diagnosis._Answer(frozen, SimpleNamespace())  # type: ignore[arg-type]
    assert answer.lacks_something is has_room
    # nor where an unseen run contradicts fitted ones; of a fitted run a law may be told: a stop
    # that one run alone reached was a change of its spring, and then "read its record first"
    frozen.gates = (SimpleNamespace(name=diagnosis.CONTRADICTED),)
    for chi2, is_told in ((1050.0, False), (9000.0, True)):
        fit = SimpleNamespace(chi2=chi2, num_samples=1000)
        found = SimpleNamespace(fit_of=lambda _, fit=fit: fit)
        answer = diagnosis._Answer(frozen, found)  # type: ignore[arg-type]
        assert answer.lacks_something is (is_told and verdict in ("named", "unknown"))


def test_the_law_that_a_screen_was_chosen_by_is_kept_when_the_budget_is_spent():
    """Friction that grows at rest was fitted, kept 278 nats, and was dropped for the budget."""
    entry = Entry("number", "friction", "-", 1.0)
    candidate = Candidate(entry, Variable("rest", "r"), bumps(0.0, 1.0), 283.0, 432.0, 0.85, 1.0)
    noisy = SimpleNamespace(chi2=300.0, num_samples=100)
    law = SimpleNamespace(nats=278.0, candidate=candidate, fit=noisy)
    after = SimpleNamespace(found=())
    screen = SimpleNamespace(
        found=(candidate,),
        holding=(candidate,),
        with_pairs=lambda _: (screen, [], 1),
        beside=lambda _: after,
    )
    screened = stage._ScreenWithFit(screen, candidate, law, 1)  # type: ignore[arg-type]
    rounds = stage._rounds(screened, None, None, lambda: False)  # type: ignore[arg-type]
    assert next(rounds) == [law]
    # where it leaves noise, no law of two variables can explain more
    quiet = SimpleNamespace(**{**vars(law), "fit": SimpleNamespace(chi2=99.0, num_samples=100)})
    unasked = SimpleNamespace()
    assert stage._fit_pairs(unasked, None, [quiet], None, (), 0.0) == (unasked, [])  # type: ignore


def test_pairs_are_asked_for_wherever_something_pushes():
    """Of a reaction readings alone seemed to lack something, and its product was not tried."""
    reading, rate, number = (Entry(kind, "a", "-", 1.0) for kind in ("reading", "rate", "number"))
    laws = [SimpleNamespace(entry=e, nats=9.0) for e in (reading, rate, number)]
    fitted = SimpleNamespace(
        nats=9.0, candidate=laws[0], fit=SimpleNamespace(chi2=900.0, num_samples=100)
    )
    asked = []
    screen = SimpleNamespace(
        found=laws, with_pairs=lambda entries: (asked.extend(entries), screen, [], 1)[1:]
    )
    stage._fit_pairs(screen, None, [fitted], None, (), 0.0)  # type: ignore[arg-type]
    assert asked == [reading, rate]


def test_the_simplest_near_form_is_weighed_beside_the_best():
    """Slopes told a reaction's line from two thresholds by less than bumps err."""
    entry = Entry("rate", "a", "1/s", 1.0)
    basis = bumps(0.0, 1.0)
    candidate = Candidate(entry, Variable("a", "a"), basis, 90.0, 90.0, 0.9, 1.0)

    def form(nats, term, **numbers):
        kind = SimpleNamespace(name=term, signed=True, scales=(), power=0.0)
        return SimpleNamespace(form=kind, nats=nats, size=1.0, numbers=numbers, term=term)

    first, second = form(15.9, "first", at=(0.5, 0.1)), form(17.4, "second", at=(0.2, 0.1))
    both = ["first", "second"]
    for behind, explained, kept in (
        (2.0, 90.0, ["first", "line"]),
        (20.0, 90.0, both),
        (100.0, 17e3, [*both, "line"]),  # of a resistance over its temperature
    ):
        near = [first, second, form(15.9 + behind, "line")]
        law = SimpleNamespace(candidate=candidate, forms=near, left=0.0, nats=explained)
        assert [made.term for made in stage._laws_of(law, 0.0)] == kept  # type: ignore[arg-type]


def test_a_product_is_one_law_whichever_of_its_variables_comes_first():
    """Of a reaction two were weighed, and the answer was that these runs cannot tell which."""
    entry = Entry("rate", "a", "1/s", 1.0)
    a, b, c = (Variable(name, name) for name in "abc")

    def law(variable, form, term):
        return Law("", entry, variable, form, term, 1.0, "1/s")

    product = law(b.with_factor(a), "line", "size*(u)")
    bent = law(b.with_factor(a), "threshold", "size*(max(u - threshold, 0))")
    mirrored = law(a.with_factor(b), "power", "size*(u**exponent)")
    other = law(c.with_factor(a), "line", "size*(u)")
    alone = law(a, "line", "size*(u)")
    kept = stage._without_twins([product, bent, mirrored, other, alone])
    assert kept == [product, bent, other, alone]
    assert stage._without_twins([mirrored, bent]) == [mirrored, bent]  # none is a product


def test_a_hidden_mass_is_tried_within_its_resonance():
    """Between two periods that are tried lies no mass whose resonance both of them miss."""
    steps = np.diff(np.log(SWINGING))
    assert steps.max() < 2.0 * LIGHTLY  # the width of half the power


def test_what_slopes_promise_does_not_displace_what_the_simulator_shows():
    """A wind was not weighed, for a reading that slopes promised 226 nats which it did not keep."""
    promised, kept, behind = _law(-1481.0, -1255.0), _law(-1405.0), _law(-1452.0)
    assert stage._near_best([behind, promised, kept]) == [promised, kept]


def test_what_the_best_memory_remembers_is_weighed_however_far_behind():
    """Beside a delay that a search finds later it may be as good."""
    memory = _law(-100.0, name="memory of speed", memory="relaxation", of="speed")
    plain, other = _law(-9000.0, name="speed"), _law(-8000.0, name="voltage")
    assert stage._near_best([plain, other, memory]) == [memory, plain]


def _law(evidence, reach=None, name="speed", memory="", of=""):
    variable = SimpleNamespace(name=name, memory=memory, of=of)
    candidate = SimpleNamespace(variable=variable, entry="entry")
    reach = evidence if reach is None else reach
    fit = SimpleNamespace(nats=evidence)
    return SimpleNamespace(fit=fit, reach=reach, candidate=candidate)


@pytest.fixture(scope="module")
def listed():
    """An answer that names a cause of the library for certain."""
    push = lambda angle, speed, temp: -2e-4 * speed * abs(speed)  # noqa: E731
    return found(turntable_study(push, uses=("fit", "fit", "select", "test"), count=130))


@pytest.mark.story  # a whole diagnosis
def test_a_cause_of_the_library_stays_certain_beside_laws_that_mimic_it(listed):
    (row,) = [row for row in listed.causes if row.status == CERTAIN]
    assert listed.verdict == "named" and row.name == MIMIC


def test_an_answer_whose_budget_ended_before_laws_says_so(listed):
    search = SimpleNamespace(settings=SearchSettings(refit_steps=GIVEN))
    answer = diagnosis._without_laws(diagnosis._Answer(listed, search))  # type: ignore[arg-type]
    assert all(row.status != CERTAIN for row in answer.frozen.causes)
    assert any("not looked for" in line for line in sentences(answer.frozen, None, ()))
    unknown = replace(answer.frozen, verdict="unknown", named=())
    assert "without laws" in headline(unknown, ())


def test_a_doubt_leaves_causes_likely(listed):
    answer = doubted(listed, diagnosis.AS_GOOD)
    assert all(row.status != CERTAIN for row in answer.causes)
    (row,) = [row for row in answer.causes if row.name == MIMIC]
    assert row.status == LIKELY and row.doubts == (diagnosis.AS_GOOD,)


@dataclass(frozen=True)
class Frozen:
    """What of an answer a doubt concerns."""

    frozen: Any


@pytest.mark.cpu(8)
@pytest.mark.parametrize(("ahead", "is_certain"), [(0.01, True), (-0.01, False)])
def test_a_cause_is_certain_only_beyond_the_odds_of_a_law(listed, ahead, is_certain):
    """A law that explains as much, its price paid, leaves a cause of the library likely."""
    answer = diagnosis._doubted_beside(
        Frozen(listed),  # type: ignore[arg-type]
        nats=100.0,
        of_law=100.0 - diagnosis.ALONE_NATS - ahead,
    )
    assert any(row.status == CERTAIN for row in answer.frozen.causes) is is_certain


@pytest.mark.parametrize(
    ("entry", "of", "form", "unit"),
    [
        ("Pa/s", "Pa", forms.FORMS[0], "1/s"),  # a leak
        ("-", "K", forms.FORMS[0], "1/K"),  # a resistance
        ("N m", "rad/s", forms.FORMS_THROUGH_ZERO[2], "N m s^2/rad^2"),
        ("K/s", "K", forms.FORMS[5], "K/s"),  # it saturates
        ("N", "-", forms.FORMS[0], "N"),
    ],
)
def test_the_size_of_a_law_has_the_unit_of_what_it_multiplies(entry, of, form, unit):
    """That of a line was the unit of the place alone."""
    at, variable = Entry("rate", "a", entry, 1.0), Variable("a", "a", of)
    candidate = Candidate(at, variable, bumps(0.0, 1.0), 90.0, 90.0, 0.9, 1.0)
    made = stage._unit_of_size(candidate, form)
    assert to_si(made) == to_si(unit) or made == unit
    twice = replace(candidate, variable=replace(variable, times=Variable("b", "b", "V")))
    assert factor(stage._unit_of_size(twice, form), f"{unit.replace('-', '1')}/V") == 1.0
