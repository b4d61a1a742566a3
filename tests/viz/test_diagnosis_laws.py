"""The page of an answer that holds laws nobody listed: picture, formula, what else was weighed."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.diagnose.judge.records import HALF_LEVEL, CauseRow, Interval
from diffsim.diagnose.say.law_records import (
    DESCRIBED,
    DescribedLaw,
    LawAnswer,
    LawCurve,
    Number,
    RunCurve,
    ScreenRow,
)
from diffsim.viz import diagnosis_laws
from diffsim.viz import diagnosis_report as dr
from diffsim.viz.diagnosis_laws import MOST_ROWS, laws_section, write_formula
from tests.optional import needs
from tests.viz.test_diagnosis_report import CAUSES, example, series

needs("matplotlib", reason="reports need pip install -e '.[viz]'")
needs("plotly", reason="reports need pip install -e '.[viz]'")
needs("jinja2", reason="reports need pip install -e '.[viz]'")

SENTENCE = "a torque at shaft that repeats 14 times a turn of angle, 0.0022 N m; looks like cogging"
SIZE, WAVE, PHASE = 2.2e-3, 14.0, 0.4
U = np.linspace(-1.0, 1.0, 401)
COGGING = DescribedLaw(
    name="law_1",
    entry={"kind": "force", "target": "shaft"},
    variables=("angle",),
    memory=None,
    form="periodic",
    formula="size*sin(wave_number*u + phase)",
    numbers={
        "amplitude": Number(SIZE, 2.1e-3, 2.3e-3, "N m"),
        "wave_number": Number(WAVE, 13.9, 14.1, "-"),
    },
    sentence=SENTENCE,
    looks_like=("cogging",),
    status="certain",
)
CURVES = (
    LawCurve("", (0.0, 1.0), (5.0, 6.0), (1.0, 1.0)),  # of another place
    LawCurve(
        "law_1",
        tuple(U.tolist()),
        tuple((SIZE * np.sin(WAVE * U + PHASE)).tolist()),
        (1e-4,) * len(U),
        "N m",
        (
            RunCurve("run_1", tuple(U[:301].tolist()), tuple(np.sin(WAVE * U[:301]).tolist())),
            RunCurve("run_2", tuple(U[100:].tolist()), tuple(np.cos(WAVE * U[100:]).tolist())),
        ),
    ),
)
SCREEN = (
    ScreenRow("force", "shaft", "speed", 90.0, 0.4, 0.0),
    ScreenRow("force", "shaft", "angle", 900.0, 0.95, 14.0),
    ScreenRow("force", "shaft", "heat of current^2", 9.0, 0.2, 0.0, "heat", "current"),
    *(ScreenRow("number", "drag", f"column_{k}", 9.0, 0.1, 0.0) for k in range(20)),
)
ANSWER = LawAnswer((COGGING,), SCREEN, CURVES, 474)
VALUES = {"law_1": SIZE, "wave_number_of_law_1": WAVE, "phase_of_law_1": PHASE}


@pytest.fixture(autouse=True)
def _no_nuisances(monkeypatch):
    monkeypatch.setattr(series, "held_out_point", lambda fit, run: (fit.x, None))


def described(answer=ANSWER, status="certain", values=VALUES, **changes):
    size = {"size": Interval(SIZE, 2.1e-3, 2.3e-3)}
    cause = CauseRow("law_1", "law 1", "effect", status, 0.9, size, "N m")
    report = example(
        verdict=DESCRIBED,
        named=("law_1",),
        causes=(cause, *CAUSES[1:]),
        described=answer,
        rivals=(),
        **changes,
    )
    report.best.values = values
    return report


def test_the_law_stands_first_with_its_picture(tmp_path):
    report = described()
    titles = [s.title for s in dr.diagnosis_page(report).sections]
    assert titles[:2] == ["Measured and predicted, on test runs", "Laws that nobody listed"]
    text = dr.write_diagnosis(report, tmp_path / "report.html").read_text("utf-8")
    read = text.replace("\xa0", " ")
    assert SENTENCE[1:] in read and "0.0022 (0.0021 to 0.0023) N m" in read
    assert "a law that is not in the library" in read


def test_without_a_law_the_table_comes_after_the_causes():
    nothing = LawAnswer((), SCREEN, CURVES, 474)
    titles = [s.title for s in dr.diagnosis_page(example(described=nothing)).sections]
    at = titles.index("Laws that nobody listed")
    assert titles[at - 1] == "What acts, and what does not"
    (section,) = laws_section(example(described=nothing))
    (table,) = section.content
    assert len(table.rows) == MOST_ROWS and not table.emphasis


def test_a_page_says_nothing_of_laws_that_were_not_looked_for():
    titles = [s.title for s in dr.diagnosis_page(example()).sections]
    assert "Laws that nobody listed" not in titles


def test_the_picture_holds_band_and_formula_over_three_periods():
    chart = laws_section(described())[0].content[0]
    band, first, second, asked, formula = chart.figure.data
    reach = 2.0 * np.pi / WAVE * 3.0
    assert reach - 0.02 < np.ptp(asked.x) <= reach
    half = (max(band.y) - min(band.y)) / 2.0 - SIZE
    assert half == pytest.approx(HALF_LEVEL * 1e-4, rel=0.02)
    expected = SIZE * np.sin(WAVE * np.array(formula.x) + PHASE)
    np.testing.assert_allclose(formula.y, expected, atol=1e-3 * SIZE)
    assert chart.figure.layout.xaxis.title.text == "angle"
    assert chart.figure.layout.yaxis.title.text == "force at shaft [N m]"
    assert SENTENCE[1:] in chart.caption
    # each run in a color of its own, over the part that is drawn and where it went
    assert (first.name, second.name) == ("run_1", "run_2")
    assert first.line.color != second.line.color
    assert min(first.x) == pytest.approx(min(asked.x)) and max(first.x) <= U[300]
    assert min(second.x) >= U[100] and max(second.x) == pytest.approx(max(asked.x))


@pytest.mark.parametrize(
    ("kind", "moved"),
    [("number", lambda f: 1.3 * (1.0 + f) - 1.0), ("force", lambda f: f + 0.3)],
)
def test_the_formula_lies_on_what_other_numbers_of_the_model_moved(kind, moved):
    """The term before it has a form was fitted with another drag, or another constant force."""
    size, u = 0.5, np.linspace(0.0, 1.0, 101)
    line = replace(
        COGGING,
        entry={"kind": kind, "target": "drag"},
        variables=("temperature",),
        form="line",
        formula="size*u",
        numbers={"amplitude": Number(size, 0.4, 0.6, "-")},
    )
    sd = np.where(u < 0.5, 0.01, 0.1)
    curve = LawCurve("law_1", *(tuple(a.tolist()) for a in (u, moved(size * u), sd)))
    answer = LawAnswer((line,), SCREEN, (curve,), 9)
    chart = laws_section(described(answer, values={"law_1": size}))[0].content[0]
    _, asked, formula = chart.figure.data
    np.testing.assert_allclose(
        np.interp(asked.x, formula.x, formula.y), np.array(asked.y), atol=1e-4
    )


def test_a_law_of_a_hidden_state_says_what_the_formula_is_of():
    heat = replace(COGGING, variables=("current",), memory="heat", formula="size*u")
    chart, table, screen = laws_section(described(replace(ANSWER, laws=(heat,))))[0].content
    assert chart.figure.layout.xaxis.title.text == "heat of current"
    rows = dict(table.rows)
    assert rows["hidden state"] == "heat" and rows["formula"] == "size*u, u being heat of current"
    assert rows["with its numbers"] == "0.0022*(heat of current)"
    assert screen.emphasis == [2]  # the state, not the angle itself


def test_a_law_beside_the_best_set_has_no_numbers_to_draw():
    bare = replace(COGGING, numbers={}, status="possible")
    chart, table, _ = laws_section(described(replace(ANSWER, laws=(bare,)), values={}))[0].content
    drawn = [line.name for line in chart.figure.data]
    assert drawn == ["90 % band", "run_1", "run_2", "as the runs ask for it"]
    assert "with its numbers" not in [row[0] for row in table.rows]


def test_the_table_says_what_the_law_was_chosen_from():
    *_, table = laws_section(described())[0].content
    assert table.emphasis == [1]
    assert table.rows[1] == ["force at shaft", "angle", "95", "900", "14"]
    assert "474" in table.caption


def test_a_likely_law_is_not_called_certain():
    for status, tone in (("certain", "good"), ("likely", "fair")):
        card = dr.diagnosis_page(described(status=status)).numbers[0]
        assert (card.value, card.tone) == (DESCRIBED, tone)
        assert ("likely" in card.note) == (status == "likely")


@pytest.mark.parametrize(
    ("formula", "text", "latex"),
    [
        ("size*sin(k*u)", "0.002*sin(14.0*heat)", r"0.002 \sin{\left(14.0 \mathrm{heat} \right)}"),
        ("size*max(u - k, 0)", "0.002*max(0, heat - 14.0)", None),
        ("size*u*abs(u)", "0.002*heat*abs(heat)", None),
        ("size/(u + k)**2", "0.002/(heat + 14.0)**2", r"\frac{0.002}{\left(\mathrm{heat} + 14.0"),
    ],
)
def test_formulas_are_written_with_their_numbers(formula, text, latex):
    pytest.importorskip("sympy", reason="sympy comes with torch")
    written = write_formula(formula, {"size": 2e-3, "k": 14.0}, {"u": "heat"})
    assert written.text == text
    assert latex is None or latex in written.latex


def test_a_formula_of_what_sympy_has_no_word_for_stays_as_it_is():
    assert write_formula("size*hypot(u, 1)", {"size": 2.0}, {"u": "x"}) is None


def test_without_sympy_the_formula_stays_as_it_is(monkeypatch):
    def missing(module, purpose):
        raise ImportError(module)

    monkeypatch.setattr(diagnosis_laws, "optional", missing)
    assert write_formula("size*u", {"size": 2.0}, {"u": "x"}) is None
    table = laws_section(described())[0].content[1]
    assert "formula" in [row[0] for row in table.rows]
    assert "as LaTeX" not in [row[0] for row in table.rows]
