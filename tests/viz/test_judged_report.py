"""The page of a judgment: what a saved model says of new runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.records import ErrorRow, OutsideRow
from diffsim.diagnose.judge.rivals import cause_words
from diffsim.diagnose.judge.unseen import Unseen
from diffsim.diagnose.say.headline import judged_headline
from diffsim.identify.model_file import SavedModel
from diffsim.viz.judged_report import judgment_page
from diffsim.viz.report import write
from tests.optional import needs

needs("plotly")


TIME = np.linspace(0.0, 1.0, 40)
CHANNELS = (Channel(name="place", unit="m", kind="position", sd=0.002, shown_unit="mm"),)
GAIN = Gain(0.9, 0.7, 1.1, 5.0, 8)
SAVED = SavedModel(
    Path("extended_model.yaml"),
    {"drag": 0.2, "mass": 1.5, "arm": 0.3},
    {"drag": 0.02, "mass": 0.1, "arm": 0.0},
    ("mass", "arm"),
    ("drag",),
    "named",
    units={"drag": "N s/m", "mass": "kg", "arm": "m"},
    plain={"mass": 1.6, "arm": 0.3},
    facts={"noise": {"place": {"sd": 0.001}}, "seen_runs": {"sine": {}}},
)


def recorded(name) -> Run:
    measured = np.sin(6.0 * TIME)[:, None]
    return Run(name, TIME, measured, {"u": np.cos(TIME)}, name, 0, "test")


RUNS = {name: recorded(name) for name in ("slow", "fast", "lost")}
STUDY = Study("cart", "ode", CHANNELS, tuple(RUNS.values()))


def error(run, after=1.1) -> ErrorRow:
    return ErrorRow(run, "position", "mm", 2.5, after, 1.0, 40, 1)


def found(**changes) -> Unseen:
    judged = ("slow", "fast")
    predicted = {n: (RUNS[n].measured + 2e-3, RUNS[n].measured + 1e-4) for n in judged}
    given = {
        "runs": judged,
        "errors": tuple(map(error, judged)),
        "gain": GAIN,
        "gains": dict.fromkeys(judged, GAIN),
        "outside": (OutsideRow("fast", "rate of u", 3.0, -1.0, 1.0, 3.0, "N/s"),),
        "predicted": predicted,
    }
    return Unseen(**{**given, **changes})


def sections(page) -> dict:
    return {section.title: section for section in page.sections}


def test_all_judged_runs_are_drawn_with_errors_gain_and_distance(tmp_path):
    page = judgment_page(found(), STUDY, SAVED)
    assert page.verdict == [
        "With the extended model the error on unseen runs falls from 2.5 to 1.1 mm, noise 1 mm."
    ]
    assert [n.value for n in page.numbers] == ["1.1", "90"]
    parts = sections(page)
    errors, outside = parts["Error on these runs"].content
    assert [row[0] for row in errors.rows] == ["slow", "fast"] and errors.rows[0][2:4] == [
        "2.5",
        "1.1",
    ]
    assert outside.rows[0][:2] == ["fast", "rate of u"]
    (gains,) = parts["Gain, run by run"].content
    assert gains.rows[1] == ["fast", "90", "70 to 110", "confirmed"]
    (chart,) = parts["Measured and predicted"].content
    names = {trace.name for trace in chart.figure.data}
    assert names == {"measured ± noise", "model before", "extended model"}
    assert len(chart.figure.data) == 2 * 5  # both runs, three signals and two that are left
    before = chart.figure.data[0]
    np.testing.assert_allclose(before.y, 1000.0 * np.sin(6.0 * TIME) + 2.0, rtol=1e-3, atol=1e-3)
    (sizes,) = parts["What was judged"].content
    assert [row[0] for row in sizes.rows] == ["drag", "mass"]  # arm is the same in both
    text = write(judgment_page(found(), STUDY, SAVED), tmp_path / "judge.html").read_text("utf-8")
    assert page.verdict[0] in text and "http" not in text.partition("<script")[0]


def test_the_band_is_drawn_around_the_extended_model_and_its_share_said():
    held = ErrorRow("slow", "position", "mm", 2.5, 1.1, 1.0, 40, 1, "test", 2.0, 37)
    bands = {"slow": np.full((40, 1), 2e-3), "fast": np.full((40, 1), np.nan)}
    page = judgment_page(found(errors=(held, error("fast")), bands=bands), STUDY, SAVED)
    number = page.numbers[-1]
    assert (number.value, number.unit, number.tone) == ("92", "%", "good")
    errors = sections(page)["Error on these runs"].content[0]
    band = list(errors.columns).index("90 % band ±")
    assert [row[band : band + 2] for row in errors.rows] == [["2", "92 %"], ["–", "–"]]
    (chart,) = sections(page)["Measured and predicted"].content
    assert "90 %" in chart.caption
    areas = [trace for trace in chart.figure.data if trace.name == "90 % band"]
    assert len(areas) == 2  # around the model and around zero, where it is known
    middle = 1000.0 * np.sin(6.0 * TIME) + 0.1
    expected = np.concatenate([middle + 2.0, (middle - 2.0)[::-1]])
    np.testing.assert_allclose(areas[0].y, expected, rtol=1e-3, atol=1e-3)
    assert np.ptp(areas[1].y) == pytest.approx(4.0)


def test_a_run_that_fails_and_runs_inside_are_said():
    lost = found(failed={"lost": "it runs away"}, gain=None, outside=())
    page = judgment_page(lost, STUDY, SAVED)
    said = sections(page)["Error on these runs"].text
    assert said == [
        "Run lost could not be simulated: it runs away",
        "All runs lie inside of what was fitted.",
    ]
    assert len(page.numbers) == 1  # no gain over chosen runs
    none = found(failed={"lost": "it runs away"}, errors=(), gain=None, gains={}, predicted={})
    page = judgment_page(none, STUDY, SAVED)
    assert page.verdict == ["No run could be simulated."]
    assert "Measured and predicted" not in sections(page)


def test_a_plain_model_has_no_gain():
    plain = SavedModel(**{**vars(SAVED), "components": ()})
    page = judgment_page(found(), STUDY, plain)
    assert page.verdict == ["The error on unseen runs is 2.5 mm, noise 1 mm."]
    assert "names no cause" in sections(page)["Gain, run by run"].text[0]
    (chart,) = sections(page)["Measured and predicted"].content
    assert {trace.name for trace in chart.figure.data} == {"measured ± noise", "model before"}


def test_a_judgment_praises_no_gain_that_is_not_there():
    worse = judged_headline([error("a", 3.0)], None, extended=True)
    assert (
        worse
        == "With the extended model the error on unseen runs rises from 2.5 to 3 mm, noise 1 mm."
    )
    unsure = judged_headline([error("a")], Gain(0.2, -0.1, 0.5, 2.0, 9), extended=True)
    assert unsure == (
        "With the extended model the error on unseen runs falls from 2.5 to 1.1 mm, noise 1 mm. "
        "Not certain: the gain may be chance on unseen runs."
    )


def test_a_share_of_next_to_nothing_is_no_number():
    """A card "nothing to gain" showed 0 %, with an interval up to 577 %."""
    nothing = Gain(0.0, 0.0, 5.77, -0.08, 80)
    page = judgment_page(found(gain=nothing, gains={"slow": nothing, "fast": GAIN}), STUDY, SAVED)
    assert [n.value for n in page.numbers] == ["1.1"]
    (gains,) = sections(page)["Gain, run by run"].content
    assert gains.rows[0] == ["slow", "–", "–", "nothing to gain"]
    assert gains.rows[1][1:3] == ["90", "70 to 110"]
    nought, sure = cause_words(
        {"a": found(gain=nothing), "b": found(gain=GAIN)}, {"a": "A", "b": "B"}
    )
    assert nought.endswith("; nothing to gain.") and "noise removed" not in nought
    assert sure.endswith("; 90 % of the error above the noise removed: confirmed.")


def test_numbers_of_the_page_are_in_the_unit_of_its_first_sentence():
    """ "6.3 to 2.8 mm" stood beside a card of "0.0028 m", and sentences without a unit."""
    rows = tuple(
        ErrorRow(n, "position", "m", 0.0063, 0.0028, 0.0029, 40, 1, band=0.0045, held=0.0735)
        for n in ("slow", "fast")
    )
    causes = {"drag": found(errors=rows)}
    page = judgment_page(found(errors=rows, causes=causes), STUDY, SAVED)
    assert page.verdict == [
        "With the extended model the error on unseen runs falls from 6.3 to 2.8 mm, noise 2.9 mm."
    ]
    card = page.numbers[0]
    assert (card.value, card.unit, card.note) == ("2.8", "mm", "before: 6.3, noise alone: 2.9")
    errors = sections(page)["Error on these runs"].content[0]
    row = dict(zip(errors.columns, errors.rows[0], strict=True))
    assert [row[k] for k in ("before", "after", "noise", "held", "90 % band ±", "unit")] == [
        "6.3", "2.8", "2.9", "73.5", "4.5", "mm"
    ]  # fmt: skip
    assert "position 6.3, with it 2.8 mm" in sections(page)["Gain, run by run"].text[0]


def test_a_judged_run_is_not_called_fitted():
    """What the study says it is used for is not what it was used for here."""
    runs = tuple(replace(run, use="fit") for run in STUDY.runs)
    page = judgment_page(found(), replace(STUDY, runs=runs), SAVED)
    chart = sections(page)["Measured and predicted"].content[0].figure
    labels = [button.label for menu in chart.layout.updatemenus for button in menu.buttons]
    assert labels == ["slow (test)", "fast (test)"]


def test_names_in_the_table_of_sizes_are_words():
    named = replace(
        SAVED,
        values={**SAVED.values, "viscous_friction": 2.0},
        sd={**SAVED.sd, "viscous_friction": 0.1},
        components=("viscous_friction",),
    )
    table = sections(judgment_page(found(), STUDY, named))["What was judged"].content[0]
    assert table.rows[0][0] == "viscous friction"
