"""The answer in a sentence of at most 25 words; why it is not certain in a second one."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, product
from types import MappingProxyType

import numpy as np

from diffsim.core.figures import figure
from diffsim.core.units import after_number, small_scale
from diffsim.diagnose.checks.gates import CONTRADICTED, LAWS
from diffsim.diagnose.judge.described import MOST_NAMES
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.preconditions import ENDED, MAY_BE_ANOTHER, why_unconfirmed
from diffsim.diagnose.judge.records import (
    ALIKE_SHARE,
    CERTAIN,
    DATA_SHEET,
    EFFECT,
    LIKELY,
    ONE_LAW,
    CauseRow,
    ErrorRow,
    pooled_by_kind,
)
from diffsim.diagnose.judge.unseen import OF_ONE_RUN
from diffsim.diagnose.say.factors import stated_of, times_all_drives
from diffsim.diagnose.say.wording import (
    Answer,
    capital,
    effects_of,
    join_words,
    opened,
    plain_name,
    size_range,
    times_words,
    twin_words,
    wrong_sheets,
)

MAX_SIZED = 2  # causes whose sizes are said
MAX_OPEN = 9  # words for what cannot be told apart
MAX_WORDS = 25
NOT_CERTAIN = "Not certain:"
TOGETHER = 0.5  # of the misfit, all that causes remove one by one: below it they act as one
SMALL = 0.05  # of what all remove: causes that the first sentence leaves to the page
UNKNOWN_CAUSE, UNNAMED = "unknown ", "something without a name"
SURELY, PROBABLY, PERHAPS = "certainly", "probably", "perhaps"
_VERBS = {SURELY: "{}", PROBABLY: "{} probably", PERHAPS: "may be"}  # the less sure, the later
_PLURALS = ("pulses",)  # of causes that are several things
#: A clause on "it" as one on "them".
_OF_SEVERAL = (
    (r"^its (\w+)", r"their \1s"),
    (r"^it helps\b", "they help"),
    (r"^it\b", "they"),
    (r"\bit does$", "they do"),
    (r"\bit leaves$", "they leave"),
    (r"\b(by|without|for) it\b", r"\1 them"),
)
_COUNTS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"]


def headline(
    answer: Answer,
    errors: Sequence[ErrorRow],
    failed: Collection[str] = (),
    gained: Gain | None = None,
    laws: Collection[str] = (),
) -> str:
    """The answer: what is missing, and the error on test runs before and after, in 25 words.

    A second sentence says why that is not certain, a third one that the noise is not as stated.

    Args:
        errors: Errors on runs that were not fitted; none without such runs.
        failed: Runs that could not be simulated; errors are not quoted then.
        gained: Gain over all these errors; None: not known.
        laws: Names of the causes that no library holds.
    """
    is_denied = False  # nothing is certain, and what is named leaves the unseen error as it was
    if errors and not failed and all(row.status != CERTAIN for row in effects_of(answer)):
        row = _quoted_kind(errors, True, gained)
        is_denied = row.after > ALIKE_SHARE * row.before
    found = _say_findings(answer, laws, is_denied=is_denied)
    endings = _endings(answer, errors, failed, gained)
    # the longest words that fit with an ending: the error comes before details of the cause
    texts = [f"{a}{b}." for a, b in (*product(found, endings), *product(found, ("",)))]
    first = next((text for text in texts if len(text.split()) <= MAX_WORDS), texts[-1])
    second = _second(answer, errors, failed, gained, first)
    return " ".join([first, *second, *_noise(errors, gained)])


def first_of(said: str) -> str:
    """The first sentence of a headline; a point within it, as of a number, ends none."""
    return re.split(r"(?<=\.) (?=Not certain: |No gain is known: |The stated noise )", said)[0]


def judged_headline(
    errors: Sequence[ErrorRow],
    gained: Gain | None,
    *,
    extended: bool,
    gains: Mapping[str, Gain] = MappingProxyType({}),
) -> str:
    """The errors of a saved model on new runs in a sentence; first, where some kinds of runs get
    worse and others better, which.

    Args:
        errors: Errors on the runs; none where no run could be simulated.
        gained: Gain over all of them; None: not known.
        extended: Whether the model names a cause.
    """
    if not errors:
        return "No run could be simulated."
    if not extended:
        return f"The {_on_unseen(errors, False, gained)[0].lstrip('; ').removeprefix('the ')}."
    ending = _on_unseen(errors, True, gained, "falls from ")[0].lstrip(":; ").removeprefix("but ")
    with_model = f"With the extended model the {ending.removeprefix('the ')}."
    if ending.startswith("no skill"):
        with_model = f"The extended model has {ending}."
    doubts = [f"{NOT_CERTAIN} {why}." for why in _of_gain(gained)]
    return " ".join([*_by_kind(gains), with_model, *doubts, *_noise(errors, gained)])


def _by_kind(gains: Mapping[str, Gain]) -> list[str]:
    """Which kinds of runs get better and which worse, where both are: "better on gravity (2 of 2),
    worse on heavy (8 of 8)"."""
    kinds: dict[str, list[Gain]] = {}
    for run, gain in gains.items():
        kinds.setdefault(OF_ONE_RUN.sub("", run), []).append(gain)
    said: dict[str, list[str]] = {"Better": [], "worse": []}
    for kind, own in kinds.items():
        num_worse = sum(gain.status == "withdrawn" for gain in own)
        num_better = sum(gain.is_above_zero for gain in own)
        if num_worse != num_better:
            verb, most = ("worse", num_worse) if num_worse > num_better else ("Better", num_better)
            said[verb].append(f"{kind} ({most} of {len(own)})" if len(own) > 1 else kind)
    if not all(said.values()):
        return []
    parts = [f"{verb} on {join_words(names[:MOST_NAMES])}" for verb, names in said.items()]
    return [f"{', '.join(parts)}."]


def _endings(
    answer: Answer, errors: Sequence[ErrorRow], failed: Collection[str], gained: Gain | None
) -> list[str]:
    if failed:
        return [f"; run {min(failed)} could not be simulated", "; a run cannot be simulated"]
    changed = any(row.helps or row.status in (CERTAIN, LIKELY) for row in effects_of(answer))
    changed = changed or answer.before_test is not None  # what was taken back made a change
    objects = "; but"
    if answer.is_taken_back or answer.verdict == "unknown":  # the error is why, or none to a name
        objects = ":" if answer.is_taken_back else ";"
    return _on_unseen(errors, changed, gained, objects=objects) if errors else [""]


def _second(
    answer: Answer,
    errors: Sequence[ErrorRow],
    failed: Collection[str],
    gained: Gain | None,
    first: str,
) -> list[str]:
    """Why the first sentence is not certain; that nothing tests it."""
    no_test = not errors and not failed
    untested = ["No gain is known: no run is kept for a test."] if no_test else []
    if answer.verdict in ("numerical", "unrepeatable", "none"):
        return untested
    twin = twin_words(answer) if answer.causes_with(LIKELY) else ""
    said = [*filter(None, [twin]), *_of_gain(gained), *_reasons(answer, first)]
    if any(gate.name == LAWS for gate in answer.gates):
        ended = ENDED[answer.is_full]
        said = [*(why for why in said if why not in ENDED), f"{ended}, without laws"]
    return [*(f"{NOT_CERTAIN} {why}." for why in said[:1]), *untested]


def _reasons(answer: Answer, first: str) -> list[str]:
    """Doubts of what the first sentence names, else of all that is; that of a first answer last;
    whose it is where others have none, and where the first sentence names it."""
    rows = [r for r in answer.causes_with(CERTAIN, LIKELY) if r.doubts or r.status == CERTAIN]
    of_sheets = "data sheet" in first  # of which all drives are one
    named = [
        row
        for row in rows
        if _brief(row.words).lower() in first.lower() or (of_sheets and row.origin == DATA_SHEET)
    ]
    if any(row.doubts for row in named):
        rows = named
    doubts = dict.fromkeys(why for row in _by_share(rows) for why in row.doubts)
    said = []
    for why in sorted(doubts, key=lambda why: why in ENDED):
        own = [row for row in rows if why in row.doubts]
        is_of_all = len(own) == len(rows) or why in ENDED or not named
        whose = "" if is_of_all else f"{join_words([_brief(row.words) for row in own[:2]])}, as "
        text = f"{whose}{_of_several(why) if whose and len(own) > 1 else why}"
        said.append(text if len(text.split()) <= MAX_WORDS - len(NOT_CERTAIN.split()) else why)
    return said


def _of_several(why: str) -> str:
    """A doubt of one cause as one of several."""
    for pattern, plural in _OF_SEVERAL:
        why = re.sub(pattern, plural, why)
    return why


def _of_gain(gained: Gain | None) -> list[str]:
    """What unseen runs leave open."""
    if gained is None or gained.status in ("confirmed", "nothing to gain", "withdrawn"):
        return []
    if gained.status == "cannot be judged":
        return ["unseen runs cannot judge it"]
    return [f"{why_unconfirmed(gained)} on unseen runs"]


def _noise(errors: Sequence[ErrorRow], gained: Gain | None) -> list[str]:
    """That so much is removed that the noise must be less than was stated, and how much it is."""
    if gained is None or not gained.is_below_noise:
        return []
    row = min(pooled_by_kind(errors), key=lambda row: row.after / row.noise)
    _, left, unit, noise = _numbers(row)
    if not noise:
        return [f"The stated noise is too large: {left} times of it is left."]
    return [f"The stated noise of {noise} is too large: {left}{unit} is left."]


def _by_share(rows: Sequence[CauseRow], laws: Collection[str] = ()) -> list[CauseRow]:
    """Causes in the order of what each removes, laws last."""
    return sorted(rows, key=lambda row: (row.name in laws, -(row.removes or 0.0)))


def _say_findings(answer: Answer, laws: Collection[str], *, is_denied: bool = False) -> list[str]:
    """What is wrong, without a full stop; shorter ones later.

    Args:
        laws: Names of the causes that no library holds.
        is_denied: Whether unseen runs speak against what is named.
    """
    if answer.verdict == "unrepeatable":
        return ["Repeats differ more than the sensor's noise, so no cause can be judged"]
    if answer.verdict == "numerical":
        return [
            "The simulation's own step, mesh or tolerance moves the prediction by more than noise"
        ]
    if answer.verdict == "unknown":
        return _unknown(answer, laws)
    if answer.verdict == "ambiguous":
        # without a cause a data sheet is off, or nothing is
        may_be_none = () in answer.rivals and not wrong_sheets(answer)
        return _open(answer, "may be" if is_denied or may_be_none else "is")
    if answer.verdict == "data_sheet":
        return _off_sheet(_sheets_of(answer), answer.drives)
    # what the extended model holds has made the error smaller, whatever singled it out
    named = [
        r
        for r in answer.causes_with(CERTAIN, LIKELY)
        if r.origin != EFFECT or r.name in answer.named or r.removes is not None
    ]
    if named:
        return _missing(answer, named, laws, is_open=is_denied)
    nothing = "Nothing is missing that these runs could show"
    if not answer.away:
        return [nothing]
    first = answer.away[0]
    said = f"{first.words} is fitted at {times_words(first)} times what is stated"
    return [f"{nothing}; {said}", f"Nothing is missing; {said}", nothing]


def _unknown(answer: Answer, laws: Collection[str]) -> list[str]:
    """Something without a name; what helps beside it; what unseen runs took back."""
    if answer.is_taken_back and answer.before_test is not None:
        taken = [row for row in effects_of(answer) if row.name in answer.before_test.statuses]
        names = [_brief(row.words) for row in _by_share(taken, laws)[:MOST_NAMES]]
        what = join_words(names) or "What was named"
        verb = "are" if len(names) > 1 else "is"
        return [
            f"{capital(what)} {verb} withdrawn",
            "What was named is withdrawn",
        ]
    if against := [gate.note for gate in answer.gates if gate.name == CONTRADICTED]:
        run = capital(against[0].partition(" is ")[0])
        return [f"{run} contradicts the others, which leave noise alone"]
    helping = _by_share([row for row in effects_of(answer) if row.helps], laws)
    if helping and sum(row.removes or 0.0 for row in helping) > 0.5:
        them = join_words([_brief(row.words) for row in helping[:MOST_NAMES]])
        return [
            f"Something without a name is missing beside {them}",
            "Something without a name is missing beside causes of the library",
        ]
    return [
        "Something is missing that no cause of the library explains",
        "Something without a name is missing",
    ]


def _open(answer: Answer, verb: str) -> list[str]:
    """Sets of causes that cannot be told apart, without what they share.

    What is missing may be in none of them: something like them is.

    Args:
        verb: Before "missing".
    """
    if pieces := [row for row in effects_of(answer) if ONE_LAW in row.rivals]:
        them = join_words([_brief(row.words) for row in pieces[:MOST_NAMES]])
        return [
            f"One law may act in place of {them}, which undo each other",
            "One law may act in place of causes that undo each other",
        ]
    sets = [answer.best_names, *answer.rivals]
    found, wrong = _sheets_of(answer), wrong_sheets(answer)
    if found and not any(answer.rivals) and {*answer.best_names} == wrong.keys():
        return _off_sheet(found, answer.drives)  # they are off with the cause and without it
    if not any(answer.rivals) and not answer.decision.forms:
        return _unsure(answer)
    held = {row.name: row for row in effects_of(answer)}
    common = set(sets[0]).intersection(*sets[1:])
    # nor what is likely over all sets, though one of them does without it
    likely = (row for row in held.values() if row.status in (CERTAIN, LIKELY))
    wide = common | {row.name for row in likely if not any(map(MAY_BE_ANOTHER.match, row.doubts))}
    if any(n not in wide for n in sets[0]):
        common = wide.intersection(sets[0])
    # what removes most comes first; of a rival what the best set lacks, which no fit removed
    place = {row.name: k for k, row in enumerate(answer.causes)}
    held_by_best = {*sets[0]}
    sets = [
        tuple(sorted(s, key=lambda n: (k > 0 and n in held_by_best, place.get(n, len(place)))))
        for k, s in enumerate(sets)
    ]
    parts = [[_listed_name(answer, n) for n in s if n not in common] for s in sets]
    # what acts beside a name tells it from none, nor does what a set holds beyond another one's
    parts = [[n for n in p if n != UNNAMED] or p for p in parts]
    parts = [p for p in parts if not any(set(o) < set(p) for o in parts if o)]
    names = list(dict.fromkeys(" with ".join(p) for p in parts if p))
    if common and names:
        shared = [n for n in sets[0] if n in common]
        more = [n for n in sets[0] if n not in common]
        total = sum(held[n].removes or 0.0 for n in sets[0] if n in held)
        is_told = (
            len(names) == 1
            and sum(held[n].removes or total for n in more if n in held) >= SMALL * total
        )
        if len(names) == 1 and len(more) == 1 and (off := wrong.get(more[0])):
            return _beside_shared(answer, shared, names[0], verb, off)
        return _beside_shared(answer, shared, names[0] if is_told else "another cause", verb)
    if len(names) == 1 and all(parts):
        said = f"Something like {names[0]} {verb} missing"
        return [f"{said}; these runs cannot tell its form", said]
    shown = f"{names[0]}, {names[1]} or another cause" if len(names) > 2 else " or ".join(names)
    if names and len(shown.split()) > MAX_OPEN:
        shown = f"{names[0]} or another cause"
    if names and len(shown.split()) > MAX_OPEN:  # of a set what removes most
        shown = f"{names[0].partition(' with ')[0]} or another cause"
    if not names or len(shown.split()) > MAX_OPEN:
        shown = "one of several causes"
    off_sheets = list(wrong.values())
    also = f" or {off_sheets[0]} is off its data sheet" if off_sheets else ""
    if off_sheets == [shown]:  # the cause changes the very number
        also = ", or its data sheet is off"
    is_any = shown == "one of several causes" or shown.endswith(("another cause", UNNAMED))
    said = f"{capital(shown) if is_any else f'Something like {shown}'} {verb} missing{also}"
    short = [f"{capital(shown)} {verb} missing or {off_sheets[0]} off"] if " or " in also else []
    return [
        f"{said}; these runs cannot tell which",
        said,
        *([] if is_any else short),
        f"One of several causes {verb} missing; these runs cannot tell which",
    ]


def _beside_shared(
    answer: Answer, shared: Sequence[str], more: str, verb: str, off: str = ""
) -> list[str]:
    """What all sets hold, and that another cause may act beside it; the longest first.

    Args:
        more: What may act beside it, in words.
        verb: Before "missing".
        off: Number whose data sheet may be wrong instead, in words; empty: none.
    """
    names = [_brief(plain_name(answer, n)) for n in shared]
    how = {row.name: _sure(row, shared) for row in effects_of(answer) if row.name in shared}
    least = max((how.get(n, PROBABLY) for n in shared), key=tuple(_VERBS).index)
    is_are = _VERBS[least].format("are" if len(names) > 1 else "is")
    missing = f"{verb if verb == _VERBS[PERHAPS] else is_are} missing"
    rest = dict.fromkeys((f"whether {more} is, too", "whether another cause is, too"))
    said = [f"{join_words(names)} {missing}"] if len(names) <= MOST_NAMES else []
    if len(names) > 1:
        said += [f"{_count(len(names))} causes, {names[0]} first, {missing}"]
    if off:
        ends = (
            f"{more} is, too, or {off} is off its data sheet",
            f"{more} is, too, or {off} is off",
        )
        return [capital(f"{text}; {end}") for text in said for end in ends]
    leads = ("these runs leave open", "open is")
    return [capital(f"{text}; {lead} {end}") for text in said for lead in leads for end in rest]


def _listed_name(answer: Answer, name: str) -> str:
    """A cause of a set; one that the library does not hold has no name."""
    is_unknown = name.startswith(UNKNOWN_CAUSE)
    return UNNAMED if is_unknown else _brief(plain_name(answer, name))


def _unsure(answer: Answer) -> list[str]:
    """Causes that the data ask for, where nothing but their absence is a rival."""
    named = [row for row in effects_of(answer) if row.name in answer.best_names]
    said = _missing(answer, named, (), is_open=True)
    return [f"{text}; these runs leave it open" for text in said]


def _sheets_of(answer: Answer) -> list[CauseRow]:
    return [row for row in answer.causes if row.origin == DATA_SHEET]


def _off_sheet(rows: Sequence[CauseRow], drives: Sequence[str] = ()) -> list[str]:
    """Sentences on data sheets where no cause is missing, the longest first.

    Args:
        drives: Parameters that are the strengths of all drives; (): unknown.
    """
    found = [row.as_read() for row in rows]
    stated = [(row, v) for row in found if (v := stated_of(row)) is not None]
    times = times_all_drives(stated, drives) if len(rows) == len(drives) else None
    how = "" if all(row.status == CERTAIN for row in rows) else f"{PROBABLY} "
    if times is not None:
        are, say = ("All drives are", "their data sheets say")
        if len(drives) == 1:
            are, say = ("The drive is", "its data sheet says")
        strong = f"{are} {how}{figure(times)} times as strong as"
        return [f"{strong} {say}", f"{strong} stated"]
    row = found[0]
    value, unit = next(iter(row.size.values())).value, after_number(row.unit)
    prior = row.sheet.partition(" +-")[0]
    number = next((n for d in (3, 4, 5) if (n := figure(value, d)) != prior), figure(value, 6))
    numbers = f"{number}{unit}, not {prior}{unit}"
    if len(rows) == 1:
        off = f"{row.words} is {how}{numbers}"
        return [f"Only a data sheet is off: {off}", opened(off)]
    count = f"{capital(_count(len(rows)))} data sheets are {how}off"
    such = f"{count}, such as {row.words}"
    return [f"{such}: {numbers}", such, count]


def _missing(
    answer: Answer, named: Sequence[CauseRow], laws: Collection[str], *, is_open: bool = False
) -> list[str]:
    """Sentences on causes that are named, the longest first.

    Args:
        named: Causes, data sheets among them.
        laws: Names of the causes that no library holds.
        is_open: Whether none of them is surer than perhaps.
    """
    how = {row.name: PERHAPS if is_open else _sure(row, answer.named) for row in named}
    sheet = [row for row in named if row.origin == DATA_SHEET]
    effects = _by_share([row for row in named if row.origin == EFFECT], laws)
    is_surer = sheet and all({*row.doubts} <= {*ENDED} for row in sheet)
    if not effects or (is_surer and all(how[row.name] == PERHAPS for row in effects)):
        return _off_sheet(sheet, answer.drives)
    every = [*effects, *(r for r in effects_of(answer) if r.helps and r not in effects)]
    of_laws = sum(row.removes or 0.0 for row in every if row.name in laws)
    if of_laws > sum(row.removes or 0.0 for row in every if row.name not in laws):
        return _laws(every, laws, how)
    total = sum(row.removes or 0.0 for row in effects)
    is_set = len(effects) > 1 and 0.0 < total < TOGETHER
    if not is_set:
        effects = effects[: max(len(effects) - _num_small(effects, total), 1)]
    names = [*([] if is_set else _with_sizes(effects, laws, how))]
    names += _without_sizes(effects, how, is_set=is_set)
    held = _by_share([row for row in every if row.helps and row not in effects])
    if beside := held[: len(held) - _num_small(held, total)]:
        also = _count(len(beside))
        causes = "cause" if len(beside) == 1 else "causes"
        ends = (f", with {also} more {causes} left open", f", {also} more left open")
        names = [f"{said}{end}" for said in names for end in ends]
    counts = _count_causes(_by_share([*effects, *beside], laws), how, is_set=is_set)
    out = [*names, *counts]
    if sheet:
        off = f", {sheet[0].words} is off its data sheet"
        out = [f"{said}{end}" for group in (names, counts) for end in (off, "") for said in group]
    return [capital(said) for said in out]


def _laws(effects: Sequence[CauseRow], laws: Collection[str], how: Mapping[str, str]) -> list[str]:
    """Laws that remove more than the causes of the library beside them; where one of these removes
    more than next to nothing, the library explains a part."""
    own = [row for row in effects if row.name in laws]
    total = sum(row.removes or 0.0 for row in effects)
    beside = [row for row in effects if row not in own and (row.removes or 0.0) > SMALL * total]
    how = {row.name: PERHAPS for row in effects} | dict(how)
    said = _without_sizes(own, how, is_set=False)
    said += _count_causes(own, how, is_set=False, several="laws")
    none = ("No cause of the library explains it: ", "No library cause explains it: ")
    also = [f", beside {names}" for names in _some_named(beside, how)] if beside else []
    return [f"{n}{text}" for text in said for n in none if not beside] + [
        capital(f"{text}{end}") for end in dict.fromkeys((*also, "")) for text in said
    ]


def _some_named(rows: Sequence[CauseRow], how: Mapping[str, str]) -> Iterator[str]:
    """Names of causes, one at least, then of fewer, each time with how many more there are."""
    marks = [f"{PERHAPS} " if how[row.name] == PERHAPS else "" for row in rows]
    names = [f"{mark}{_brief(row.words)}" for mark, row in zip(marks, rows, strict=True)]
    for k in range(min(len(rows), MOST_NAMES), -1, -1):
        more = f"{max(marks[k:], default='')}{_count(len(rows) - k)} more"  # perhaps, where one is
        yield join_words([*names[:k], *([more] if k < len(rows) else [])])


def _num_small(effects: Sequence[CauseRow], total: float) -> int:
    """Number of the last causes, in their order, that remove next to nothing, all together."""
    if total <= 0.0:
        return 0
    rest = np.cumsum([row.removes or 0.0 for row in reversed(effects)])
    return int(np.searchsorted(rest, SMALL * total))


def _with_sizes(
    effects: Sequence[CauseRow], laws: Collection[str], how: Mapping[str, str]
) -> list[str]:
    """Names with the sizes that their words do not say, the longest first; none of many causes."""
    sized = {row.name for row in effects if row.size and row.words == words_of(row.name)}
    if not sized - set(laws) or len(effects) > MAX_SIZED:
        return []
    out = []
    for brief in (False, True):
        sizes = {r.name: f" ({size_range(r, brief=brief)})" for r in effects if r.name in sized}
        out.append(_say(effects, how, sizes))
    return list(dict.fromkeys(out))


def _without_sizes(
    effects: Sequence[CauseRow], how: Mapping[str, str], *, is_set: bool
) -> list[str]:
    """Names alone, the longest first; none of many causes.

    Args:
        effects: Causes in their order.
        how: How sure each is, by name.
        is_set: Whether they remove little one by one.
    """
    if len(effects) > MOST_NAMES:
        return []
    alone = _say(effects, how, {}, together=" together" if is_set else "")
    is_cut = len(effects) == 1 and effects[0].words != _brief(effects[0].words)
    return [_say(effects, how, {}, is_whole=True), alone] if is_cut else [alone]


def _count_causes(
    effects: Sequence[CauseRow], how: Mapping[str, str], *, is_set: bool, several: str = "causes"
) -> list[str]:
    """How many causes there are, and which one removes most.

    Args:
        several: What they are, as a plural.
    """
    if len(effects) < 2:
        return []
    sure = [row for row in effects if how.get(row.name, PERHAPS) != PERHAPS]
    up_to = "up to " if 0 < len(sure) < len(effects) else ""
    causes = f"{up_to}{_count(len(effects))} {several}{' together' if is_set else ''}"
    least = max((how.get(r.name, PERHAPS) for r in sure or effects), key=tuple(_VERBS).index)
    is_missing = f"{_VERBS[least].format('are')} missing"
    first = _brief((sure or effects)[0].words)
    return [f"{causes}, {first} first, {is_missing}", f"{causes} {is_missing}"]


def _sure(row: CauseRow, singled_out: Collection[str]) -> str:
    """How sure a cause is, as it stands before its name; nothing is probable that may be zero, in
    whose place another one may act, or without which unseen runs leave noise alone."""
    if row.status == CERTAIN:
        return SURELY
    is_open = any(map(MAY_BE_ANOTHER.match, row.doubts)) or row.name not in singled_out
    return PERHAPS if is_open else PROBABLY


def _say(
    effects: Sequence[CauseRow],
    how: Mapping[str, str],
    sizes: Mapping[str, str],
    *,
    is_whole: bool = False,
    together: str = "",
) -> str:
    """Causes in their order with how sure each is: "a and probably b are missing"."""
    grouped = [(k, list(rows)) for k, rows in groupby(effects, key=lambda row: how[row.name])]
    order = tuple(k for k, _ in grouped)
    # the verb says how sure the first ones are, but where it would be true of them alone
    by_verb = order[:1] if len(order) == 1 or order == (PROBABLY, PERHAPS) else ()
    words: list[str] = []
    for k, rows in grouped:
        mark = "" if k in by_verb or (k == SURELY and not words) else f"{k} "
        for row in rows:
            name = row.words if is_whole else _brief(row.words)
            words.append(f"{mark}{name}")
            mark = ""
    is_many = len(effects) > 1 or effects[0].words.startswith(_PLURALS)
    is_missing = "are" if is_many else "is"
    is_missing = _VERBS[by_verb[0] if by_verb else SURELY].format(is_missing)
    end = sizes.get(effects[0].name, "") if len(effects) == 1 else ""
    if len(effects) > 1:
        words = [f"{w}{sizes.get(row.name, '')}" for w, row in zip(words, effects, strict=True)]
    comma = "," if is_whole else ""
    return f"{join_words(words)}{together}{comma} {is_missing} missing{end}"


def _count(number: int) -> str:
    return _COUNTS[number] if number < len(_COUNTS) else str(number)


def _brief(words: str) -> str:
    """Words of a cause without what they say after a comma."""
    return words.partition(",")[0]


def _on_unseen(
    errors: Sequence[ErrorRow],
    changed: bool,
    gained: Gain | None,
    falls: str = "",
    objects: str = "; but",
) -> list[str]:
    """What becomes of the error, the longest first; each says it before and after.

    Args:
        errors: Errors on runs that were not fitted.
        changed: Whether the extended model differs from the plain one.
        gained: Gain over all these errors.
        falls: Verb of an error that becomes smaller, with a blank.
        objects: What leads from the finding to an error that does not become smaller.
    """
    row = _quoted_kind(errors, changed, gained)
    where, short = (
        ("error on unseen runs", "unseen error")
        if row.use == "test"
        else ("error on the runs that chose", "error")
    )
    before, after, unit, noise = _numbers(row)
    besides = f", noise {noise}" if noise else ""
    if not changed:
        return [f"; the {where} is {before}{unit}{besides}", f"; {short} {before}{unit}{besides}"]
    if row.after > ALIKE_SHARE * row.before:
        verb = "stays at" if row.after <= 1.01 * row.before else f"rises from {before} to"
        return [
            f"{objects} the {where} {verb} {after}{unit}{besides}",
            f"{objects} {short} {verb} {after}{unit}{besides}",
        ]
    if row.constant is not None and row.constant < ALIKE_SHARE * row.after:
        constant = _numbers(replace(row, before=row.constant))[0]
        of = f"{before} to {after}{unit}, a constant leaves {constant}{unit}"
        return [f"{objects} no skill: {where} {of}", f"; no skill: {short} {of}"]
    return [
        f": {where} {falls}{before} to {after}{unit}{besides}",
        f": {short} {before} to {after}{unit}{besides}",
    ]


def _numbers(row: ErrorRow) -> tuple[str, str, str, str]:
    """Errors before and after, their unit, and the noise with it; without a unit, errors over the
    noise."""
    if row.unit == "-" and row.noise > 0.0:
        before, after = (figure(v / row.noise) for v in (row.before, row.after))
        return before, after, " times the noise", ""
    shown, times = small_scale(row.unit, (row.after, row.noise))
    before, after, noise = (figure(times * v) for v in (row.before, row.after, row.noise))
    unit = after_number(shown)
    return before, after, unit, f"{noise}{unit}"


def _quoted_kind(errors: Sequence[ErrorRow], changed: bool, gained: Gain | None) -> ErrorRow:
    """All runs together, of the kind of channel whose error falls most, or is largest, over its
    noise; the one that rises most where the whole gets worse."""
    sign = -1.0 if gained is not None and gained.status == "withdrawn" else 1.0
    return max(
        pooled_by_kind(errors),
        key=lambda r: sign * (r.before - (r.after if changed else 0.0)) / r.noise,
    )
