"""What becomes of an unknown cause that repeats confirm, refute, or are too few to tell."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from diffsim.diagnose.checks.gates import REPEATED, GateResult
from diffsim.diagnose.judge import judge
from diffsim.diagnose.judge.crosscheck import SWAP_LIMIT
from diffsim.diagnose.judge.judge import Decision
from diffsim.diagnose.search.evidence import Hypothesis

A, AU, U = frozenset({0}), Hypothesis(frozenset({0}), 0), Hypothesis(frozenset(), 0)
FIT = SimpleNamespace(problem=None, residual=None)
SEARCH = cast(Any, SimpleNamespace(fit_of=lambda members: FIT))


def confirmed(decision: Decision, p: float | None, monkeypatch: pytest.MonkeyPatch) -> Decision:
    gates = () if p is None else (GateResult(REPEATED, p <= SWAP_LIMIT, p, SWAP_LIMIT),)
    monkeypatch.setattr(judge, "repeated_gate", lambda fit, seed: gates)
    return judge.confirmed(decision, SEARCH, seed=0)[0]


@pytest.mark.parametrize(
    ("p", "verdict", "rivals"),
    [
        (None, "unknown", ()),
        (0.01, "unknown", ()),
        (0.05, "ambiguous", (AU,)),
        (0.3, "named", ()),
    ],
)
def test_a_set_that_explains_half_is_named_only_if_scatter_explains_the_rest(
    p: float | None,
    verdict: str,
    rivals: tuple[Hypothesis, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = confirmed(Decision("unknown", A, (), AU, 0.5), p, monkeypatch)
    assert (found.verdict, found.best, found.rivals) == (verdict, A, rivals)
    assert (found.unknown is None) == (verdict != "unknown")


@pytest.mark.parametrize(("p", "rivals"), [(None, (AU,)), (0.01, (AU,)), (0.05, (AU,)), (0.3, ())])
def test_an_unknown_cause_as_likely_beside_it_faces_the_repeats_too(
    p: float | None, rivals: tuple[Hypothesis, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = confirmed(Decision("ambiguous", A, (AU,), None, 0.5), p, monkeypatch)
    assert (found.verdict, found.rivals) == ("ambiguous" if rivals else "named", rivals)


@pytest.mark.parametrize(("p", "verdict"), [(0.01, "unknown"), (0.05, "none"), (0.3, "none")])
def test_an_unknown_cause_alone_needs_the_repeats(
    p: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (
        confirmed(Decision("unknown", frozenset(), (), U, 0.0), p, monkeypatch).verdict == verdict
    )
