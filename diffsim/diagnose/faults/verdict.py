"""What may be said of a group: nothing visible, a named fault, or faults that cannot be told apart.

Every interval holds 90 % and is averaged over sets of causes and over the scatter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.figures import figure
from diffsim.core.units import after_number
from diffsim.diagnose.faults.candidates import Candidate
from diffsim.diagnose.faults.evidence import Evidence
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.records import CERTAIN, LIKELY, UNTOLD, Interval
from diffsim.diagnose.say.causes import PROBABLE
from diffsim.diagnose.say.headline import MAX_WORDS
from diffsim.diagnose.search.evidence import ALONE_NATS
from diffsim.identify.effect import PRIOR_WIDTH, Effect

SILENT, UNLISTED = "nothing visible", "not in the library"
SOUND = "nothing"
VERDICTS = (SILENT, CERTAIN, LIKELY, UNTOLD, UNLISTED)
SOUND_LIMIT = 0.1  # probability of "sound" below which a fault is named
CERTAIN_LIMIT = 0.05  # and below which it may be certain
MOST_SETS = 8  # explanations of a group that its verdict holds
ENDS = (0.05, 0.95)  # shares below the two ends of an interval


@checked(kinds_only=True)
@dataclass(frozen=True)
class SetRow:
    """One explanation of a group.

    Attributes:
        causes: Causes that act; none: sound, or "not in the library" where ``is_unlisted``.
        probability: With the odds that known groups give.
        probability_alone: With odds by the number of causes alone: what these runs say.
        is_unlisted: Whether it is a change that no cause of the library describes.
    """

    causes: tuple[str, ...]
    probability: float
    probability_alone: float
    is_unlisted: bool


@checked(kinds_only=True)
@dataclass(frozen=True)
class Size:
    """Size of one cause in a group.

    Attributes:
        cause: Name of the cause.
        unit: SI unit, "-" if none.
        interval: Value with its 90 % interval in that unit.
        words: The same in plain words.
    """

    cause: str
    unit: str
    interval: Interval
    words: str


@checked(kinds_only=True)
@dataclass(frozen=True)
class FaultVerdict:
    """What is said of one group.

    Attributes:
        group: Value of the fact that makes the groups.
        runs: Names of its runs.
        files: Paths of the files that they were read from, each once.
        said: What the study says was done.
        known: Causes that were changed on purpose; None: not known.
        status: One of ``VERDICTS``.
        causes: Causes that are named, by the most probable set; none if nothing is.
        sound: Probability that nothing is wrong, by these runs alone.
        strength: Length of the named causes' misfit, in sd of noise and scatter together.
        sizes: Their sizes.
        lead_by_runs, lead_by_labels: Evidence over the next explanation that lacks one of the
            causes: what these runs say, and what the labels of other groups add to it by making
            frequent faults more likely [nats]; 0 where nothing is named.
        rivals: Other sets that the runs themselves do not tell from it; ``SOUND`` and ``UNLISTED``
            stand for those without a cause.
        sets: Most probable explanations.
        smallest_visible: Smallest size of each cause that would be visible alone, in its unit.
        words: The verdict as a sentence.
        plain: Causes of ``sets`` and ``rivals`` in plain words, without a size.
        visible: Causes at the smallest size that would be visible alone, in plain words, those of
            the smallest number first.
        facts: Facts of the set-up that all its runs share, without the one that makes groups and
            those that are not known.
        set_aside: Goals that were missed and rows that were misread, under this explanation.
    """

    group: str
    runs: tuple[str, ...]
    said: str
    known: tuple[str, ...] | None
    status: str
    causes: tuple[str, ...]
    sound: float
    strength: float
    sizes: tuple[Size, ...]
    rivals: tuple[tuple[str, ...], ...]
    sets: tuple[SetRow, ...]
    smallest_visible: Mapping[str, float]
    words: str
    lead_by_runs: float = 0.0
    lead_by_labels: float = 0.0
    plain: Mapping[str, str] = field(default_factory=dict)
    visible: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    set_aside: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The group, and its first file where the group is not called like it."""
        names = [Path(file).name for file in self.files]
        if not names or names[0].startswith(self.group):
            return self.group
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        return f"{self.group} ({names[0]}{more})"

    @property
    def next_words(self) -> str:
        """What to do next about the group, in a sentence."""
        if self.status == SILENT:
            return "Nothing to do; a smaller fault would not be seen."
        if self.status == UNLISTED:
            return f"Look where runs of {self.group} leave the others, and write that as a cause."
        if self.status == CERTAIN:
            return "Mend it, record the group again, and judge that with --new: it should be sound."
        return f"Record more runs of {self.group}, or look at the part itself, before it is mended."

    @property
    def is_right(self) -> bool | None:
        """Whether exactly the known causes are named; None where they are not known."""
        return None if self.known is None else set(self.causes) == set(self.known)


def _most_telling(found: Sequence[FaultVerdict]) -> Iterator[str]:
    """The fault that most groups have, or that of one group, the longest words first."""
    causes = Counter(cause for v in found for cause in v.causes)
    for cause, number in causes.most_common(1):
        own = [v for v in found if cause in v.causes]
        if number > 1:
            yield f"; most often {_probably(own)}{own[0].plain[cause]} ({number} groups)"
    best = max(found, key=lambda v: (v.status == CERTAIN, v.strength))
    words = " and ".join(size.words for size in best.sizes) or "a change that no cause describes"
    such = "" if len(found) == 1 else "such as "
    words = f"{_probably([best])}{words}"
    yield from (f", {such}{name}: {words}" for name in (best.title, best.group))
    yield f", {such}{best.group}"


def _probably(rows: Sequence[FaultVerdict]) -> str:
    """What stands before a fault that is not certain in one of these groups."""
    return "" if all(v.status in (CERTAIN, UNLISTED) for v in rows) else "probably "


@checked(kinds_only=True)
@dataclass(frozen=True)
class Spread:
    """How far sound groups or runs differ.

    Attributes:
        quantities: Quantities of the model that share it.
        stated: First guess of the study.
        interval: What was learned, in the quantities' own unit.
    """

    quantities: str
    stated: float
    interval: Interval


@checked(kinds_only=True)
@dataclass(frozen=True)
class FaultReport:
    """Verdicts on groups, and the scatter that they were judged against.

    Attributes:
        study: Name of the study.
        spreads: Scatter between groups and between runs, from all groups that taught.
        verdicts: One per group; groups that taught are judged by the others.
    """

    study: str
    spreads: tuple[Spread, ...]
    verdicts: tuple[FaultVerdict, ...]

    @property
    def num_faulty(self) -> int:
        """Groups that differ from sound ones by more than the scatter."""
        return sum(v.status != SILENT for v in self.verdicts)

    @property
    def headline(self) -> str:
        """How many groups have a fault, how sure that is, and which fault, in at most 25 words."""
        found = [v for v in self.verdicts if v.status != SILENT]
        of = f"{len(self.verdicts)} group{'' if len(self.verdicts) == 1 else 's'}"
        if not found:
            return f"No fault is visible in {of}."
        num_sure = sum(v.sound <= CERTAIN_LIMIT for v in found)
        probably = "" if num_sure == len(found) else "probably "
        sure = f", {num_sure} of them certainly" if probably and num_sure else ""
        has = "has" if len(found) == 1 else "have"
        begin = f"{len(found)} of {of} {probably}{has} a fault{sure}"
        said = (f"{begin}{what}." for what in _most_telling(found))
        return next((text for text in said if len(text.split()) <= MAX_WORDS), f"{begin}.")

    def to_dict(self) -> dict[str, Any]:
        """The report as plain records, with ``headline``, ``is_right`` of each verdict, and
        ``groups_of_file``: by path of a file, the groups with runs of it."""
        of_file: dict[str, list[str]] = {}
        for verdict in self.verdicts:
            for file in verdict.files:
                of_file.setdefault(file, []).append(verdict.group)
        out = {"headline": self.headline, "groups_of_file": of_file, **asdict(self)}
        for row, verdict in zip(out["verdicts"], self.verdicts, strict=True):
            row["is_right"] = verdict.is_right
        return out


@dataclass(frozen=True, eq=False)
class CandidateEvidence:
    """One candidate with its evidence."""

    candidate: Candidate
    evidence: Evidence


def verdict_of(
    group: Group,
    evidences: Sequence[CandidateEvidence],
    effects: Mapping[str, Effect],
    smallest_visible: Mapping[str, float],
) -> FaultVerdict:
    """What may be said of a group.

    Args:
        effects: Causes by name.
        smallest_visible: Smallest size of each cause that would be visible alone.
    """
    level = np.array([w.evidence.log_evidence for w in evidences])
    learned = _normalize_weights(level + [w.candidate.learned_odds for w in evidences])
    alone = _normalize_weights(level + [w.candidate.log_odds for w in evidences])
    order = np.argsort(-learned)
    sound = next(i for i, w in enumerate(evidences) if w.candidate.is_sound)
    best = int(order[0])
    status = _status(evidences, learned, alone, sound, best)
    is_named = status not in (SILENT, UNLISTED)
    causes = evidences[best].candidate.causes if is_named else ()
    sizes = _sizes(causes, evidences[best].evidence, effects) if is_named else ()
    rivals = _rivals(evidences, alone, best) if is_named else ()
    by_runs, by_labels = _leads(evidences, learned, best) if is_named else (0.0, 0.0)
    sets = tuple(
        SetRow(
            evidences[i].candidate.causes,
            float(learned[i]),
            float(alone[i]),
            evidences[i].candidate.is_unlisted,
        )
        for i in order[:MOST_SETS]
    )
    asked = {cause for own in (*(row.causes for row in sets), *rivals) for cause in own}
    plain = {name: plain_words(effects[name]) for name in sorted(asked & set(effects))}
    return FaultVerdict(
        group=group.label,
        runs=tuple(run.name for run in group.runs),
        said=group.said,
        known=group.known,
        status=status,
        causes=causes,
        sound=float(alone[sound]),
        strength=evidences[best].evidence.strength if is_named else 0.0,
        sizes=sizes,
        rivals=rivals,
        sets=sets,
        smallest_visible=dict(smallest_visible),
        words=_words(status, sizes, rivals, plain),
        plain=plain,
        visible=tuple(cause_words(effects[c], v) for c, v in least_visible(smallest_visible)),
        facts=group.facts,
        files=tuple(dict.fromkeys(file for run in group.runs for file in run.files)),
        lead_by_runs=by_runs,
        lead_by_labels=by_labels,
    )


def _leads(
    evidences: Sequence[CandidateEvidence], learned: Array, best: int
) -> tuple[float, float]:
    """Lead over the most probable explanation that lacks a cause of the best one, by runs and by
    labels [nats]."""
    chosen = set(evidences[best].candidate.causes)
    lacking = [i for i, w in enumerate(evidences) if not chosen <= set(w.candidate.causes)]
    ours, theirs = (evidences[i] for i in (best, max(lacking, key=lambda i: learned[i])))

    def by_runs(w: CandidateEvidence) -> float:
        return w.evidence.log_evidence + w.candidate.log_odds

    def by_labels(w: CandidateEvidence) -> float:
        return w.candidate.learned_odds - w.candidate.log_odds

    return (
        float(by_runs(ours) - by_runs(theirs)),
        float(by_labels(ours) - by_labels(theirs)),
    )


def _status(
    evidences: Sequence[CandidateEvidence], learned: Array, alone: Array, sound: int, best: int
) -> str:
    if alone[sound] > SOUND_LIMIT:
        return SILENT
    if evidences[best].candidate.is_unlisted:
        return UNLISTED
    chosen = set(evidences[best].candidate.causes)
    holds = np.array([chosen <= set(w.candidate.causes) for w in evidences])
    is_expected = learned[holds].sum() >= PROBABLE
    if not _rivals(evidences, alone, best):
        is_certain = is_expected and alone[sound] <= CERTAIN_LIMIT
        return CERTAIN if is_certain else LIKELY
    return LIKELY if is_expected else UNTOLD


def _rivals(
    evidences: Sequence[CandidateEvidence], alone: Array, best: int
) -> tuple[tuple[str, ...], ...]:
    """Sets within reach that lack a cause of the best one; those with more causes do not count."""
    chosen = set(evidences[best].candidate.causes)
    within = alone >= alone.max() * np.exp(-ALONE_NATS)
    found = [
        (-float(p), _name(w.candidate))
        for w, p, near in zip(evidences, alone, within, strict=True)
        if near and not chosen <= set(w.candidate.causes)
    ]
    return tuple(name for _, name in sorted(found))


def _name(candidate: Candidate) -> tuple[str, ...]:
    """Causes of a candidate, or what stands for none."""
    return candidate.causes or ((SOUND,) if candidate.is_sound else (UNLISTED,))


def _sizes(
    causes: Sequence[str], evidence: Evidence, effects: Mapping[str, Effect]
) -> tuple[Size, ...]:
    out = []
    for k, cause in enumerate(causes):
        effect = effects[cause]
        values = PRIOR_WIDTH * effect.typical * evidence.samples[:, k]
        low, high = weighted_quantiles(values, evidence.weights, ENDS)
        interval = Interval(float(values @ evidence.weights), low, high)
        out.append(Size(cause, effect.unit, interval, cause_words(effect, interval.value)))
    return tuple(out)


def weighted_quantiles(
    values: Array, weights: Array, shares: tuple[float, float]
) -> tuple[float, float]:
    """Values below which two shares of the weight lie."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    at = np.searchsorted(total, np.array(shares) * total[-1])
    low, high = values[order][at]
    return float(low), float(high)


def cause_words(effect: Effect, size: float) -> str:
    """A cause at a size in plain words."""
    if effect.words is not None:
        return effect.words(size)
    return f"{words_of(effect.name)} {figure(size)}{after_number(effect.unit)}"


def plain_words(effect: Effect) -> str:
    """A cause in plain words without a size: "some more weight at rotor 1".

    Numbers of its words that differ with the size are "some".
    """
    if effect.words is None:
        return words_of(effect.name)
    said, other = (  # "16 %" is one word here
        effect.words(times * effect.typical).replace(" %", "\0%").split(" ") for times in (1.0, 2.0)
    )
    if len(said) != len(other):
        return words_of(effect.name)
    words = (a if a == b else "some" for a, b in zip(said, other, strict=True))
    return " ".join(words).replace("\0", " ")


def least_visible(smallest: Mapping[str, float]) -> list[tuple[str, float]]:
    """Causes by the smallest visible size; in the library's order where two digits agree."""
    return sorted(smallest.items(), key=lambda item: float(f"{item[1]:.1e}"))


def _words(
    status: str,
    sizes: Sequence[Size],
    rivals: Sequence[tuple[str, ...]],
    plain: Mapping[str, str],
) -> str:
    if status == SILENT:
        return "Nothing visible beyond the scatter between groups."
    if status == UNLISTED:
        return "It differs from sound groups in a way that no cause of the library describes."
    named = " and ".join(size.words for size in sizes)
    others = " or ".join(" with ".join(plain.get(c, c) for c in causes) for causes in rivals)
    start = {CERTAIN: "", LIKELY: "likely: ", UNTOLD: "perhaps: "}[status]
    end = f"; these runs alone cannot tell it from {others}" if rivals else ""
    text = f"{start}{named}{end}."
    return text[0].upper() + text[1:]


def _normalize_weights(log_weight: Array) -> Array:
    return np.asarray(np.exp(log_weight - logsumexp(log_weight)))
