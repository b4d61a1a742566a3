import pytest

from diffsim.diagnose.judge.judge import decide
from diffsim.diagnose.search.evidence import Hypothesis as H

NULL, A, B, AB = H(), H(frozenset({0})), H(frozenset({1})), H(frozenset({0, 1}))
U, AU = H(frozenset(), 0), H(frozenset({0}), 0)
N = 1000.0


def verdict(nats, chi2_null=1200.0, chi2_a=1000.0):
    named = {h: e for h, e in nats.items() if h.unknown is None}
    chi2 = {h: chi2_a + 2.0 * (max(named.values()) - e) for h, e in named.items()}
    chi2[NULL] = chi2_null
    return decide(nats, chi2, N)


def test_a_name_must_pay_four_nats():
    assert verdict({NULL: 0.0, A: 3.9}).verdict == "none"
    found = verdict({NULL: 0.0, A: 4.1})
    assert (found.verdict, found.best) == ("named", frozenset({0}))


@pytest.mark.parametrize(("behind", "expected"), [(2.9, "ambiguous"), (3.1, "named")])
def test_a_rival_within_three_nats(behind, expected):
    found = verdict({NULL: 0.0, A: 20.0, B: 20.0 - behind})
    assert found.verdict == expected
    assert found.rivals == ((B,) if expected == "ambiguous" else ())


@pytest.mark.parametrize(("behind", "expected"), [(2.9, "ambiguous"), (3.1, "named")])
def test_evidence_alone_makes_a_rival_of_what_fits_worse(behind, expected):
    chi2 = {NULL: 1200.0, A: 1000.0, B: 1020.0}
    assert decide({NULL: 0.0, A: 20.0, B: 20.0 - behind}, chi2, N).verdict == expected


@pytest.mark.parametrize(
    ("worse", "pull", "expected"),
    [(5.9, 0.0, "ambiguous"), (6.1, 0.0, "named"), (-2.0, 7.9, "ambiguous"), (-2.0, 8.1, "named")],
)
def test_what_fits_as_well_is_a_rival_whatever_its_evidence(worse, pull, expected):
    nats = {NULL: 0.0, A: 20.0, B: 8.0}
    found = decide(nats, {NULL: 1200.0, A: 1000.0, B: 1000.0 + worse}, N, {B: pull})
    assert found.verdict == expected and found.best == A.effects
    strong = {**nats, AU: 24.1}
    chi2 = {NULL: 1200.0, A: 1000.0, B: 1000.0 + worse}
    assert decide(strong, chi2, N, {B: pull}).rivals == ()  # the record holds more than these
    many = {NULL: 0, A: 1, B: 3}
    assert decide(nats, chi2, N, {B: pull}, many).rivals == ()  # three sizes fit anything
    larger = {NULL: 1200.0, A: 1000.0, H(frozenset({1, 2})): 990.0}
    assert decide({NULL: 0.0, A: 20.0, H(frozenset({1, 2})): 8.0}, larger, N).verdict == "named"


def test_a_larger_set_with_the_same_name_is_no_rival():
    assert verdict({NULL: 0.0, A: 20.0, AB: 19.0, B: 2.0}).verdict == "named"


def test_members_that_cost_little_are_dropped():
    found = verdict({NULL: 0.0, A: 20.0, B: 1.0, AB: 23.0})
    assert found.best == frozenset({0})
    assert verdict({NULL: 0.0, A: 20.0, B: 1.0, AB: 24.5}).best == frozenset({0, 1})


def test_unknown_wins_only_where_names_explain_too_little():
    assert verdict({NULL: 0.0, U: 10.0}).verdict == "unknown"
    nats = {NULL: 0.0, A: 30.0, AU: 50.0, U: 20.0}
    assert verdict(nats, chi2_a=1050.0).verdict == "unknown"  # 75 %
    assert verdict(nats, chi2_a=1030.0).verdict == "named"  # 85 %


def test_where_much_is_left_unknown_wins_beside_a_bent_sheet():
    """A tank's "command offset" left 34 noise sd, with its outlet 13 sd off the data sheet."""
    nats = {NULL: 0.0, A: 1000.0, H(A.effects, 0): 1090.0}
    chi2 = {NULL: 9e4, A: 5e3}
    assert decide(nats, chi2, N).verdict == "named"
    assert decide(nats, chi2, N, off={A: 5.1}).verdict == "unknown"
    assert decide(nats, chi2, N, off={A: 4.9}).verdict == "named"
    assert decide(nats, {**chi2, A: 3e3}, N, off={A: 5.1}).verdict == "named"  # 1.7 noise sd


def test_unknown_as_good_as_the_name_is_a_rival():
    found = verdict({NULL: 0.0, A: 10.0, U: 9.0})
    assert (found.verdict, found.rivals) == ("ambiguous", (U,))


def test_an_unknown_that_leads_is_told_beside_the_names():
    found = verdict({NULL: 0.0, A: 30.0, AU: 50.0})
    assert (found.verdict, found.rivals) == ("named", ())
    assert (found.beside, found.lead) == (AU, 20.0)
    assert verdict({NULL: 0.0, A: 30.0, AU: 33.0}).beside is None


@pytest.mark.parametrize(
    ("left", "lead", "expected"),
    [(1050.0, 1.5, (AU,)), (1050.0, -2.9, (AU,)), (1050.0, -3.1, ()), (1030.0, 1.5, ())],
)
def test_what_explains_too_little_is_not_alone_where_an_unknown_cause_is_as_likely(
    left, lead, expected
):
    found = verdict({NULL: 0.0, A: 30.0, AU: 30.0 + lead, U: 5.0}, chi2_a=left)
    assert (found.rivals, found.open_unknown) == (expected, expected[0] if expected else None)
    assert found.verdict == ("ambiguous" if expected else "named")
