"""What must hold before a cause is certain: one list, each entry with its reason in words.

``OF_THE_FIT`` is asked for every row of an answer, ``OF_NAMES`` for all that has a name, data
sheets too, ``OF_A_CAUSE`` of each effect of the best set. A function returns why its precondition
does not hold, as a clause, or nothing. Where a clause of ``LEAVES_OPEN`` fails, another set may
take the place of the cause: it is not singled out, and the choice itself is open. Where another one
fails, it is likely.

After the test runs are looked at ``doubts_of_unseen`` is asked, too: what they show can only take
away.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim.causes.readings import usual_sample
from diffsim.core.arrays import Array
from diffsim.core.figures import figure, percent
from diffsim.diagnose.checks.gates import MUCH_LEFT, MUCH_UNSEEN, GateResult, leaves_more
from diffsim.diagnose.checks.numerics import NUMERICS_GATES, could_be_misfit
from diffsim.diagnose.judge.averaging import ModelAverage
from diffsim.diagnose.judge.data_sheet import far_off
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.judge import NAMES, Judgment
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.records import SURE, BaseRow, ErrorRow
from diffsim.diagnose.search.evidence import ALONE_NATS, Hypothesis, LaplaceEvidence, unrealized
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.gauss_newton import has_exact_slopes
from diffsim.diagnose.search.simulations import Members
from diffsim.identify import Fit
from diffsim.identify.effort import FIRST_STEPS, KEEP_NATS
from diffsim.identify.ranges import SURE_SD

UNDONE = 3.0  # times as far as all causes together, that one moves the record
TIMING = "timing"  # family of what is late
TIMED = 0.5  # of a sample: stamps need not tell when between two of them something was read or set
USEFUL = 0.1  # relative error of a derivative with which a size still means something
MAY_BE_ZERO = "its size may be zero"
STAMPED = "it may be the record's stamps, as it is less than half a sample"
OTHERS_UNDO_IT = "it and others undo each other: one law may act in place of all"
FIT_AS_WELL = "other causes fit about as well"
UNCONTRADICTED = "no other recording could contradict it"
#: Doubts of a cause that what stands beside it shares: a data sheet is known beside the causes.
SHARED = re.compile(f"{UNCONTRADICTED}$|an unknown .* explains ")
FIRST_ANSWER = "this is a first answer"
CUT_SHORT = "the budget ended the search"
ENDED = (FIRST_ANSWER, CUT_SHORT)  # by whether the plain fit alone may take ``FIRST_STEPS``
NOISE_ALONE = "the plain model's error is noise alone"
#: Doubts that something else may act in a cause's place, or nothing at all: of three drawn causes
#: that were likely while unseen runs left noise alone, two were not what was hidden.
MAY_BE_ANOTHER = re.compile(
    f"{MAY_BE_ZERO}$|{OTHERS_UNDO_IT}$|{FIT_AS_WELL}$|{UNCONTRADICTED}$|it may |{NOISE_ALONE} "
)


@dataclass(frozen=True, eq=False)
class Grounds:
    """What preconditions are judged by."""

    judgment: Judgment  # the verdict and the search behind it
    about: ModelAverage  # probabilities and sizes over all sets
    members: Members  # effects that the extended model holds, by index
    fit: Fit
    gates: Sequence[GateResult] = ()  # all checks, those of numerical settings at that fit
    base: Sequence[BaseRow] = ()  # base parameters there, findings among them
    chosen_by: str = ""  # what names were held against; empty: nothing

    @property
    def search(self) -> Search:
        """Sets that were weighed."""
        return self.about.search

    def name(self, i: int) -> str:
        """An effect, by index, in plain words."""
        return words_of(self.search.wide.effects[i].name)

    @property
    def within(self) -> tuple[Hypothesis, ...]:
        """Sets within the odds of the best one, and those that fit as well."""
        return (*self.about.reach, *self.judgment.decision.equal)

    @cached_property
    def promised(self) -> dict[Members, float]:
        """Evidence of sets whose fit did not converge, with what their slopes promise [nats]."""
        out = {}
        for members, fit in self.search.fits.items():
            if fit.converged or members & self.judgment.withdrawn:
                continue
            own = LaplaceEvidence(
                fit.problem, fit.x, fit.residual, fit.jacobian, [], self.search.num_families
            )
            weighed = own.weigh(Hypothesis(frozenset(range(len(members)))))
            more = max(unrealized(fit, weighed), 0.0)
            out[members] = self.search.nats(Hypothesis(members)) + more
        return out

    @cached_property
    def refused(self) -> list[Members]:
        """The best sets with effects that the validation withdrew, where they have the evidence.

        The fit runs ask for them and unseen runs refuse them: something that the library has not
        got right acts there. What is named instead may stand in for it, unless these sets hold it
        as well.
        """
        judgment, search = self.judgment, self.search
        by_set = {h: w.nats for h, w in search.posteriors.items() if h.unknown is None}
        taken = {h.effects: n for h, n in by_set.items() if h.effects & judgment.withdrawn}
        most = max(taken.values(), default=-np.inf)
        if most < by_set[Hypothesis(judgment.decision.best)] + ALONE_NATS:
            return []
        return [members for members, nats in taken.items() if nats > most - ALONE_NATS]

    @cached_property
    def left_out(self) -> float:
        """Most that one more cause would add to the largest set that is allowed [nats]."""
        best, search = self.judgment.decision.best, self.search
        if len(best) < search.settings.max_effects:
            return 0.0
        others = set(range(len(search.wide.effects))) - best
        most = max((self.about.added(best, i) for i in others), default=0.0)
        return most if most >= KEEP_NATS else 0.0

    def added(self, i: int, beside: int | None = None) -> float:
        """Nats that a member adds to the best set, next to an unknown cause by index if there is
        one; infinite where the set without was not fitted."""
        best = self.judgment.decision.best
        both, without = Hypothesis(best, beside), Hypothesis(best - {i}, beside)
        if without not in self.search.posteriors or both not in self.search.posteriors:
            return float("inf")
        return self.search.nats(both) - self.search.nats(without)


def _fit_is_inexact(g: Grounds) -> str:
    """Of its slopes intervals are made; other causes' slopes tell what else could be."""
    if not g.fit.converged:
        return "the fit did not converge"
    if g.members in g.search.borrowed:
        return "other causes could not be simulated beside it"
    at = g.search.simulations.fitted[g.members]
    is_exact = has_exact_slopes(at, max(g.fit.chi2 - g.fit.num_samples, 0.0))
    return "" if is_exact else "sizes rest on approximate derivatives"


def _settings_are_coarse(g: Grounds) -> str:
    failed = [x.name for x in g.gates if x.name in NUMERICS_GATES and not x.passed]
    if failed:
        return f"the {failed[0].replace('_', ' ')} is too coarse for it"
    if g.members and g.search.null.case.settings.accept_numerics:
        return "numerical settings were not checked with it"
    return ""


def _is_first_answer(g: Grounds) -> str:
    is_full = g.search.null.case.settings.plain_steps > FIRST_STEPS
    return ENDED[is_full] if g.search.is_cut_short else ""


def _parameters_are_far_off(g: Grounds) -> str:
    far = far_off(g.base, unknown_acts=g.judgment.decision.beside is not None)
    if not far:
        return ""
    worst = max(far, key=lambda words: abs(far[words]))
    return f"{worst} is {abs(far[worst]):.0f} standard deviations off its data sheet"


def _much_is_left(g: Grounds) -> str:
    rest = float(np.sqrt(g.fit.chi2 / g.fit.num_samples))
    return f"what the fit leaves is {figure(rest, 2)} times the noise" if rest > MUCH_LEFT else ""


def _is_a_single_recording(g: Grounds, i: int) -> str:
    case = g.search.null.case
    num = len(case.study.runs) + case.num_tests
    return UNCONTRADICTED if num < 2 else ""


def _sets_do_without(g: Grounds, i: int) -> str:
    decision = g.judgment.decision
    # causes are chosen by what coarse steps leave as well, and backlash does what these get wrong
    if leaves_more(g.fit) and could_be_misfit(g.fit, g.gates):
        return "what the fit leaves may be the simulation's own error"
    if decision.unknown is None and decision.open_unknown is not None:
        return "an unknown cause may act as well"
    if not all(i in h.effects for h in g.within) or g.about.probability(i) < SURE:
        return FIT_AS_WELL
    if _may_be_replaced(g, i):
        return "more causes at once, which were not tried, may do without it"
    if i in decision.forms:
        return f"it may be {decision.forms[i]}"
    return ""


def _stands_in_for_what_was_refused(g: Grounds, i: int) -> str:
    return "" if all(i in s for s in g.refused) else "it may stand in for what unseen runs refused"


def _may_be_zero(g: Grounds, i: int) -> str:
    """Its size, or what it and others do together: a root, a line and a level are a weir. Where
    each moves the record several times as far as all of them, what acts may be one law.

    Of what is late, less than half a sample is as good as zero: a record says that something was
    read between two stamps, or that a command was set then, and not when."""
    problem, own = g.fit.problem, dict[str, Array]()
    for effect in problem.effects:
        columns = problem.columns_of(effect)
        own[effect.name] = g.fit.jacobian[:, columns] @ g.fit.x[columns]
    moved = own.get(g.search.wide.effects[i].name)
    if moved is not None and np.linalg.norm(moved) > UNDONE * np.linalg.norm(sum(own.values())):
        return OTHERS_UNDO_IT
    if g.about.may_be_zero(i):
        return MAY_BE_ZERO
    effect = g.search.wide.effects[i]
    if (effect.family, effect.unit) != (TIMING, "s"):
        return ""
    untold = TIMED * max(run.row_s or usual_sample([run]) for run in problem.runs)
    is_told = any(max(abs(s.low), abs(s.high)) >= untold for s in g.about.size(i).values())
    return "" if is_told else STAMPED


def _helps_nothing(g: Grounds, i: int) -> str:
    """Its interval lies at zero or below, although there is something to gain."""
    gain = g.judgment.gains.get(i)
    if gain is None or not gain.high <= 0.0 < gain.excess:
        return ""
    return f"it helps nothing on {_unseen(g)}"


def _gain_is_not_confirmed(g: Grounds, i: int) -> str:
    """Of the cause, and of the whole set where there is anything to gain."""
    gain, total = g.judgment.gains.get(i), g.judgment.gain
    if gain is None or total is None:
        return "it could not be tested on what was not fitted"
    if why := why_unconfirmed(total):
        return f"{why} on {_unseen(g)}"
    return "" if gain.has_fallen else f"no gain by it is confirmed on {_unseen(g)}"


def why_unconfirmed(total: Gain) -> str:
    """Why the gain of a whole set is not confirmed; where the plain model's error is noise alone,
    it must still fall for sure: what is told by one recording alone may be its noise."""
    if total.status == "nothing to gain":
        return "" if total.has_fallen else NOISE_ALONE
    if total.status == "confirmed":
        return ""
    far, what = total.farthest
    if far > SURE_SD and total.is_above_zero:
        return f"the gain needs {what} {figure(far, 2)} standard deviations off"
    # beside an error that falls "no gain" would contradict itself
    return "the gain may be chance" if total.value > 0.0 else "no gain is confirmed"


def _evidence_does_without(g: Grounds, i: int) -> str:
    """The set without it was fitted for the gain, after the choice, and ended lower."""
    return "" if g.added(i) >= KEEP_NATS else "the others explain nearly as much without it"


def _unknown_explains_more(g: Grounds, i: int) -> str:
    """Than a cause does; of a law that nobody listed all that is known is its form, which leaves
    nothing if it is right."""
    decision = g.judgment.decision
    h = decision.beside
    if h is None or h.unknown is None:
        return ""
    name = words_of(g.search.unknowns[h.unknown].name)
    if g.search.wide.effects[i].price:  # its form was chosen
        return f"an {name} explains what it leaves"
    return f"an {name} explains more than it does" if decision.lead > g.added(i, h.unknown) else ""


def wrong_gradients(gates: Sequence[GateResult]) -> frozenset[str]:
    """Names of effects whose gradient check failed; what was left out of it is none."""
    failed = (gate.name for gate in gates if gate.applies and not gate.passed)
    return frozenset(n.partition(":")[2] for n in failed if n.startswith("gradient:"))


def said_gradient(gate: GateResult, whose: str = "its derivative") -> str:
    """What a failed gradient check means for sizes.

    Args:
        whose: The derivative of what.
    """
    if gate.value < USEFUL:
        good = f"sizes are good to {100 * gate.value:.1g} %"
        return f"{whose} could not be confirmed to {gate.limit:g}; {good}"
    return f"{whose} could not be confirmed: two ways to compute it differ by {percent(gate.value)}"


def _gradients_are_wrong(g: Grounds, i: int) -> str:
    failed = wrong_gradients(g.gates)
    best, sets = g.judgment.decision.best, (*g.within, *g.judgment.decision.rivals)
    rivals = {k for h in sets if not h.effects >= best for k in h.effects - best}
    rivals |= set(g.judgment.as_good)
    wrong = [k for k in (i, *sorted(rivals)) if g.search.wide.effects[k].name in failed]
    if not wrong:
        return ""
    whose = "its derivative" if wrong[0] == i else f"the derivative of {g.name(wrong[0])}"
    name = f"gradient:{g.search.wide.effects[wrong[0]].name}"
    return said_gradient(next(gate for gate in g.gates if gate.name == name), whose)


def _rivals_ended_early(g: Grounds, i: int) -> str:
    best = g.search.nats(Hypothesis(g.judgment.decision.best))
    without = {s: nats for s, nats in g.promised.items() if i not in s}
    if not without or max(without.values()) < best - ALONE_NATS:
        return ""
    members = max(without, key=lambda s: without[s])
    names = " and ".join(g.name(k) for k in sorted(members))
    return f"the fit of {names or 'the plain model'} did not converge"


def _neighbor_is_as_good(g: Grounds, i: int) -> str:
    others = [k for k, instead in g.judgment.as_good.items() if i in instead]
    return f"{g.name(others[0])} does nearly as well on {_unseen(g)}" if others else ""


def _unseen(g: Grounds) -> str:
    return "runs with use: select" if "select" in g.chosen_by else "parts that were left out"


OF_THE_FIT: tuple[Callable[[Grounds], str], ...] = (
    _fit_is_inexact,
    _settings_are_coarse,
    _is_first_answer,
)
OF_NAMES: tuple[Callable[[Grounds], str], ...] = (
    *OF_THE_FIT[:-1],
    _much_is_left,
    _parameters_are_far_off,
    _is_first_answer,
)
LEAVES_OPEN: tuple[Callable[[Grounds, int], str], ...] = (
    _is_a_single_recording,
    _sets_do_without,
    _stands_in_for_what_was_refused,
    _may_be_zero,
    _helps_nothing,
)
OF_A_CAUSE: tuple[Callable[[Grounds, int], str], ...] = (
    *LEAVES_OPEN,
    _gain_is_not_confirmed,
    _evidence_does_without,
    _unknown_explains_more,
    _neighbor_is_as_good,
    _gradients_are_wrong,
    _rivals_ended_early,
)


def doubts_of_fit(grounds: Grounds) -> tuple[str, ...]:
    """Why nothing is certain, not even that something unknown acts."""
    return tuple(why for ask in OF_THE_FIT if (why := ask(grounds)))


def doubts_of_names(grounds: Grounds) -> tuple[str, ...]:
    """Why nothing that has a name is certain; empty where all preconditions hold."""
    return tuple(why for ask in OF_NAMES if (why := ask(grounds)))


def doubts_of(grounds: Grounds, i: int) -> tuple[str, ...]:
    """Why an effect of the best set, by index, is not certain; empty where it is."""
    own = tuple(why for ask in OF_A_CAUSE if (why := ask(grounds, i)))
    return (*own, *doubts_of_names(grounds))


def singled_out(grounds: Grounds) -> frozenset[int]:
    """Effects of the best set in whose place nothing else may act, by index."""
    decision = grounds.judgment.decision
    if decision.verdict not in NAMES:
        return frozenset()
    return frozenset(i for i in decision.best if not any(ask(grounds, i) for ask in LEAVES_OPEN))


def doubts_of_unseen(gain: Gain | None, errors: Sequence[ErrorRow]) -> Iterator[str]:
    """Why nothing is certain once runs were looked at that chose nothing.

    Args:
        gain: Gain on test runs; None without such runs, or where one could not be simulated.
        errors: Errors on runs that were not fitted.
    """
    if gain is not None and (why := why_unconfirmed(gain)):
        yield f"{why} on test runs"
    left = max((r / n for r, n in _pool_errors(errors).values()), default=0.0)
    if left > MUCH_UNSEEN:
        yield f"the error on unseen runs is {figure(left, 2)} times the noise"


def _pool_errors(errors: Sequence[ErrorRow]) -> Mapping[tuple[str, str], tuple[float, float]]:
    """Error of the extended model and noise over all runs, by kind and unit of the channels."""
    sums: dict[tuple[str, str], tuple[float, float]] = {}
    for row in errors:
        after, noise = sums.get(key := (row.kind, row.unit), (0.0, 0.0))
        sums[key] = (
            after + row.num_samples * row.after**2,
            noise + row.num_samples * row.noise**2,
        )
    return {key: (a**0.5, n**0.5) for key, (a, n) in sums.items() if n > 0.0}


def _may_be_replaced(g: Grounds, i: int) -> bool:
    """Whether sets larger than were fitted could do without a member.

    Without it the evidence falls by so much that even twice what one more cause adds elsewhere does
    not make up for it: then it stands, whatever else acts.
    """
    if g.left_out == 0.0:
        return False
    nats = {h: w.nats for h, w in {**g.search.linear, **g.search.posteriors}.items()}
    without = max(n for h, n in nats.items() if i not in h.effects)
    return max(nats.values()) - without < 2.0 * g.left_out + ALONE_NATS
