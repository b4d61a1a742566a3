"""What an answer says of laws that nobody listed, and of the numbers that they act on."""

from dataclasses import replace
from types import SimpleNamespace

from diffsim.diagnose.discover.answer import in_words
from diffsim.diagnose.judge.records import BaseRow, CauseRow, Interval
from diffsim.identify.law import Entry, Law, Variable
from tests.optional import needs

needs("plotly")


def test_a_number_that_a_law_multiplies_is_no_finding_of_its_data_sheet():
    """A bulk modulus of 5.6e8 was certain, and 9.1e8: the law beside it had the rest."""
    from tests.viz.test_diagnosis_report import example

    def sheet(name):
        size = {name: Interval(5.6e8, 5.5e8, 5.7e8)}
        return CauseRow(name, name, "data sheet", "certain", 1.0, size, "Pa")

    def base(name):
        ends = (5.6e8, 1e6, 5.5e8, 5.7e8, 1e9, 5e7)
        return BaseRow(name, name, "Pa", *ends, -8.8, 3.0, finding=True)

    pressure = Variable("p", "pressure", "Pa")
    laws = [
        Law("law_bulk", Entry("number", "bulk", "-", 1.0), pressure, "line", "size*u", 0.5, "-"),
        Law("law_leak", Entry("rate", "leak", "Pa/s", 1.0), pressure, "line", "size*u", 0.5, "-"),
        Law("law_mass", Entry("number", "mass", "-", 1.0), pressure, "line", "size*u", 0.5, "-"),
    ]
    held = [SimpleNamespace(name="law_bulk"), SimpleNamespace(name="law_leak")]
    report = replace(
        example(),
        causes=tuple(map(sheet, ("bulk", "leak", "mass"))),
        base=tuple(map(base, ("bulk", "leak", "mass"))),
        best=SimpleNamespace(problem=SimpleNamespace(effects=held)),
    )
    said = in_words(report, SimpleNamespace(laws=laws))
    assert [row.name for row in said.causes] == ["leak", "mass"]  # of law_mass nothing is held
    assert {row.name: row.finding for row in said.base} == {
        "bulk": False,
        "leak": True,
        "mass": True,
    }


def test_doubts_call_laws_in_words():
    """ "Law of elbow_Nm_at_elbow_rad_2 does nearly as well" was the reason in a headline."""
    from tests.viz.test_diagnosis_report import example

    rate, torque = Variable("w", "rate", "rad/s"), Variable("u", "command", "N m")
    force, number = Entry("force", "hinge", "N m", 1.0), Entry("number", "mass", "-", 1.0)
    placed = [
        ("law_of_w_at_hinge", force, rate),
        ("law_of_w_at_hinge_2", force, rate),
        ("law_of_u_at_mass", number, torque),
    ]
    laws = [Law(name, at, of, "line", "size*u", 0.5, "N m") for name, at, of in placed]
    codes = ("law of w at hinge 2", "law of u at mass")
    doubts = (*(f"{code} does nearly as well" for code in codes), "the gain may be chance")
    row = CauseRow("law_of_w_at_hinge", "", "effect", "likely", 0.9, {}, "N m", doubts=doubts)
    best = SimpleNamespace(problem=SimpleNamespace(effects=[]))
    report = replace(example(), causes=(row,), base=(), best=best)
    (said,) = in_words(report, SimpleNamespace(laws=laws)).causes
    assert said.words == "a torque at hinge that depends on w"
    assert said.doubts == (
        "another law of w does nearly as well",
        "a change of mass that depends on u does nearly as well",
        "the gain may be chance",
    )
