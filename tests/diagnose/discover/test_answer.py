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
