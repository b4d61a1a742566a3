"""The page of a diagnosis: all of its parts, in order, and figures that show what they say."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim import mesh
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import EffectRow, ForceMap, Gain, GateResult, NextRun, Report
from diffsim.diagnose.judge.records import BaseRow, CauseRow, ErrorRow, Interval, OutsideRow
from diffsim.identify import MovingShape, Parameter, SimModel, WhiteNoise
from diffsim.viz import charts as plotting
from diffsim.viz import diagnosis_charts as charts
from diffsim.viz import diagnosis_report as dr
from diffsim.viz import diagnosis_series as series
from diffsim.viz import diagnosis_tables as tables
from diffsim.viz import report as page
from diffsim.viz.diagnosis_motion import moving_runs
from diffsim.viz.diagnosis_series import PredictedRun
from tests.browser import CHROMIUM, Browser
from tests.optional import needs

needs("matplotlib", reason="reports need pip install -e '.[viz]'")
needs("plotly", reason="reports need pip install -e '.[viz]'")
needs("jinja2", reason="reports need pip install -e '.[viz]'")

pytestmark = pytest.mark.serial  # a browser draws the pages


CHANNELS = (
    Channel(name="tip_z_m", unit="m", kind="", sd=1e-4),
    Channel(name="tip_x_m", unit="m", kind="", sd=1e-4),
)
PLACED = tuple(replace(c, kind="position") for c in CHANNELS)
GAIN = Gain(value=0.97, low=0.93, high=0.99, excess=2.0, num_blocks=10)
FORCE = ForceMap(
    name="unknown force",
    groups=("calm", "pushed"),
    components=("north_0", "north_1", "down_0", "down_1"),
    values=np.array([[0.1, 0.2, 0.0, 0.3], [9.0, 1.0, 0.5, -4.0]]),
    noise=np.ones((2, 4)),
)


def comparison(name: str, use: str, lag: float, seed: int) -> PredictedRun:
    """A made-up swing that the model before leads by ``lag`` [s]."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 3.0, 150)
    truth = np.stack([4e-3 * np.sin(6.0 * t), 1e-3 * np.cos(6.0 * t)], -1)
    early = np.stack([4e-3 * np.sin(6.0 * (t + lag)), 1e-3 * np.cos(6.0 * (t + lag))], -1)
    return PredictedRun(
        name=name,
        use=use,
        time_s=t,
        command={"pull_N": np.sin(6.0 * t)},
        measured=truth + 1e-4 * rng.normal(size=truth.shape),
        group=name,
        null=early,
        extended=truth,
    )


RUNS = (comparison("a", "fit", 0.02, 1), comparison("b", "test", 0.03, 2))


class Predicted:
    """A fit whose predictions are known."""

    def __init__(self, runs, which: str):
        known = {run.name: torch.from_numpy(getattr(run, which)) for run in runs}
        self.x = np.array([1.0])
        self.problem = SimpleNamespace(
            model=SimModel(lambda *_: None, (), "beam"),  # which shows nothing
            shape_at=lambda run, x: None,
            predict=lambda run, x: known[run.name] * x[0],
            runs=tuple(r for r in runs if r.use == "fit"),
            whitener=WhiteNoise(CHANNELS),
            names=("a",),
        )
        self.residual = np.concatenate(
            [
                self.problem.whitener.matrix(r) @ (r.measured - getattr(r, which)).ravel()
                for r in self.problem.runs
            ]
        )


@pytest.fixture(autouse=True)
def _no_nuisances(monkeypatch):
    monkeypatch.setattr(series, "held_out_point", lambda fit, run: (fit.x, None))


def row(effect: str, status: str, size: float, sd: float, unit: str, **more) -> EffectRow:
    settings = {
        "family": effect,
        "kind": "force",
        "nats": None,
        "z": 1.0,
        "smallest_visible": {"size": 0.003},
        "gain": None,
        "share": None,
        "aliases": (),
    }
    return EffectRow(
        effect=effect,
        status=status,
        size={"size": size},
        sd={"size": sd},
        unit=unit,
        **{**settings, **more},
    )


CAUSES = (
    CauseRow(
        "delay", "a delay of the command", "effect", "certain", 1.0,
        {"size": Interval(0.021, 0.0193, 0.0227)}, "s", gain=GAIN,
    ),
    CauseRow(
        "lag <b>", "a lag of the motor", "effect", "cannot be told from", 0.4,
        {"size": Interval(0.02, 0.01, 0.03)}, "s", rivals=("backlash",),
    ),
    CauseRow(
        "square_drag_at_upper_bend", "square drag at upper bend", "effect", "likely", 0.98,
        {"size": Interval(0.00199, 0.000977, 0.00305)}, "rad s^2/rad^2", removes=0.004,
        gain=Gain(0.0, 0.0, 0.0, -0.6, 20, fall=0.04), note="Force -size v |v|. " * 4,
    ),
    CauseRow(
        "unknown", "unknown drift of closing", "unknown", "cannot be told from", 0.0, {}, "-",
        rivals=("square_drag_at_upper_bend", "cubic_stiffness_at_bend", "slow_share"),
    ),
    CauseRow(
        "drag", "drag", "effect", "not visible below", 0.01, {}, "-",
        smallest_visible={"size": 0.003},
    ),
)  # fmt: skip
BASE = (
    BaseRow("a", "gain", "-", 1.4, 0.02, 1.37, 1.43, 1.0, 0.1, 4.0, 3.0, finding=True),
    BaseRow("offset@a", "offset", "m", 0.0, 0.1, -0.2, 0.2, 0.0, 0.1, 0.0, 3.0, run="a"),
)
ERRORS = (
    ErrorRow("b", "position", "mm", 2.1, 0.12, 0.1, 150, 2),
    ErrorRow("c", "position", "mm", 0.9, 0.10, 0.1, 50, 2),
)
HEADLINE = "The command acts 21 ms late. It takes the error on unseen runs from 2.1 mm to 0.12 mm."


def example(runs=RUNS, channels=CHANNELS, **changes) -> Report:
    rows = (
        row(
            "delay", "named", 0.021, 0.001, "s", nats=212.4, gain=GAIN, share=0.98,
            aliases=("clock offset",),
        ),
        row("lag <b>", "rival", 0.02, 0.002, "s", nats=-3.0),
        row("drag", "screened", 0.0, np.nan, "-", note="small"),
    )  # fmt: skip
    recorded = tuple(
        Run(r.name, r.time_s, r.measured, r.command, r.group, r.order, r.use) for r in runs
    )
    base = [Parameter("a", 1.0, 0.1), Parameter("offset@a", 0.0, 0.1)]
    settings = {
        "study": Study("swing", "soft_body", channels, recorded, {"geometry": {}}),
        "model": SimModel(lambda *_: None, base, "beam"),
        "verdict": "named",
        "decision": None,
        "floor": SimpleNamespace(
            sd=np.array([c.sd for c in channels]),
            source=("repeats", "repeats"),
            scatter_ratio=np.full(2, np.nan),
        ),
        "sentences": ("The command acts 21 ± 2 ms late.", "It explains 98 % of the misfit."),
        "named": ("delay",),
        "hypotheses": (),
        "table": rows,
        "screened": SimpleNamespace(
            names=("delay", "drag", "lag <b>"),
            confounding=np.array([[1.0, 0.1, 0.97], [0.1, 1.0, -0.2], [0.97, -0.2, 1.0]]),
        ),
        "cannot_see": {"tilt": "leaves no trace"},
        "gates": (GateResult(name="mesh", passed=False, value=3.1, limit=2.0, note="lambda"),),
        "num_spikes": 2,
        "rivals": (("lag <b>",),),
        "gain": GAIN,
        "null": Predicted(runs, "null"),
        "best": Predicted(runs, "extended"),
        "next_run": NextRun("hold and release", {"hold and release": 1258.0, "sine": 2.0}, 600.0),
        "settings": {"seed": 3},
        "headline": HEADLINE,
        "causes": CAUSES,
        "base": BASE,
        "errors": ERRORS if any(r.use == "test" for r in runs) else (),
        "outside": (OutsideRow("b", "amplitude of pull_N", 1.5, -1.0, 1.0, 1.5, "N"),),
        "unknown_share": 0.02,
        "interval_factor": 1.4,
        "chosen_by": "select runs",
    }
    return Report(**{**settings, **changes})


def test_page_has_its_parts_in_order(tmp_path):
    text = dr.write_diagnosis(example(), tmp_path / "report.html").read_text("utf-8")
    parts = [
        HEADLINE,
        "Measured and predicted, on test runs",
        "What acts, and what does not",
        "Error on runs that nothing has seen",
        "Base parameters against their data sheets",
        "Where and when the model is off",
        "Where a force is missing",
        "What mimics what",
        "What these data cannot see",
        "Which run to record next",
        "Checks before physics is blamed",
        "Held fixed",
    ]
    places = [text.find(part) for part in parts]
    assert min(places) > 0 and places == sorted(places)
    read = text.replace("\xa0", " ")  # numbers and units stay on one line
    assert "21 (19.3 to 22.7) ms" in read and "hold and release" in text and "FAILED" in text
    assert "lag &lt;b&gt;" in text and "<td>lag <b>" not in text  # escaped


def test_one_file_with_its_script_once(tmp_path):
    """No network: the charts' script is inside, once, and nothing is fetched."""
    text = dr.write_diagnosis(example(), tmp_path / "report.html").read_text("utf-8")
    assert text.count(plotting.packed_script()) == 1 and len(text) < 3_000_000
    own = text.replace(plotting.packed_script(), "")
    assert "src=" not in own and "<link" not in own and own.count("Plotly.newPlot") == 4


def test_first_words_are_plain_and_the_error_has_its_unit():
    shown = dr.diagnosis_page(example())
    assert list(shown.verdict) == [HEADLINE]
    error = next(n for n in shown.numbers if n.label.startswith("rms error of position"))
    # 150 samples of 0.12 mm and 50 of 0.10 mm
    assert (error.value, error.unit) == ("0.115", "mm") and "before: 1.87" in error.note
    assert not any("_" in word for line in shown.verdict for word in line.split())


def test_the_page_does_not_call_certain_what_is_likely():
    for status, tone in (("certain", "good"), ("likely", "fair")):
        causes = tuple(replace(c, status=status) if c.name == "delay" else c for c in CAUSES)
        card = dr.diagnosis_page(example(causes=causes)).numbers[0]
        assert (card.value, card.tone) == ("named", tone)
        assert ("are certain" in card.note) == (status == "certain")


def test_green_only_where_the_interval_excludes_zero():
    for low, tone, word in ((0.1, "good", "confirmed"), (-0.1, "fair", "not confirmed")):
        gain = Gain(value=0.3, low=low, high=0.5, excess=2.0, num_blocks=10)
        card = dr.diagnosis_page(example(gain=gain)).numbers[-1]
        assert card.tone == tone and card.label.endswith(f": {word}")


def test_all_test_runs_are_drawn():
    runs = (*RUNS, *(comparison(f"t{k}", "test", 0.01, k) for k in range(7)))
    figure = charts.runs_over_time([r for r in runs if r.use == "test"], CHANNELS)
    (menu,) = figure.layout.updatemenus
    assert menu.name == "run"
    labels = [button.label for button in menu.buttons]
    assert labels == ["b (test)", *(f"t{k} (test)" for k in range(7))]
    assert len(figure.data) == 8 * 2 * 5  # runs, channels, lines and what is left
    for button in menu.buttons:  # one run at a time
        assert sum(button.args[0]["visible"]) == 2 * 5


def test_runs_are_drawn_in_the_unit_of_the_recordings():
    channels = tuple(replace(c, shown_unit="mm") for c in CHANNELS)
    figure = charts.runs_over_time(RUNS[1:], channels)
    before, after, measured, left, rest = figure.data[:5]
    np.testing.assert_allclose(measured.y, 1e3 * RUNS[1].measured[:, 0], rtol=1e-4)
    np.testing.assert_allclose(np.add(left.y, before.y), measured.y, atol=1e-3)
    np.testing.assert_allclose(np.add(rest.y, after.y), measured.y, atol=1e-3)
    assert figure.layout.annotations[0].text == "tip_z_m [mm]"


def test_what_is_left_is_drawn_in_the_unit_of_the_sentence():
    """The first sentence said 1.02 mrad, the chart beside it 0.001 rad."""
    figure = charts.runs_over_time(RUNS[1:], CHANNELS)
    left, rest = figure.data[3:5]
    far = np.abs(RUNS[1].measured - RUNS[1].null)[:, 0].max()
    assert far < 0.1 and figure.layout.annotations[1].text == "measured minus predicted [mm]"
    np.testing.assert_allclose(left.y, 1e3 * (RUNS[1].measured - RUNS[1].null)[:, 0], rtol=1e-3)
    assert np.abs(rest.y).max() > 1e-3 * np.abs(left.y).max()


def test_channels_that_no_run_measured_are_not_drawn():
    blank = RUNS[1].measured.copy()
    blank[:, 0] = np.nan
    figure = charts.runs_over_time([replace(RUNS[1], measured=blank)], CHANNELS)
    assert [a.text for a in figure.layout.annotations][::2] == ["tip_x_m [m]"]


def test_many_long_runs_are_thinned_and_that_is_said(monkeypatch):
    monkeypatch.setattr(plotting, "CHART_POINTS", 30 * 2 * 5 * 100)
    monkeypatch.setattr(plotting, "FEWEST_POINTS", 50)
    runs = (*RUNS, *(comparison(f"t{k}", "test", 0.01, k) for k in range(29)))
    figure = charts.runs_over_time(runs[1:], CHANNELS)
    assert {len(line.x) for line in figure.data} == {100}  # of 150 samples
    shown = next(s for s in dr.diagnosis_page(example(runs)).sections if "on test runs" in s.title)
    assert "Of the 150 samples of the longest run 100 are drawn, evenly." in shown.text
    assert plotting.points_per_line(1) == plotting.MAX_POINTS


def test_axes_have_names_with_units_and_still_commands_no_panel():
    figure = charts.residual_views(RUNS, CHANNELS)
    titles = [figure.layout[a].title.text for a in ("xaxis", "xaxis2", "xaxis3")]
    assert titles == ["time [s]", "phase of pull_N [rad]", "frequency [Hz]"]
    still = [replace(run, command={"pull_N": np.ones(len(run.time_s))}) for run in RUNS]
    assert "over the command" not in [
        a.text for a in charts.residual_views(still, CHANNELS).layout.annotations
    ]
    shown = tuple(replace(c, shown_unit="mm") for c in PLACED)
    where = charts.over_position(RUNS, shown)
    assert where is not None and where.layout.xaxis.title.text == "tip_z_m, predicted [mm]"
    assert max(where.data[1].x) == pytest.approx(4.0, rel=0.1)  # a swing of 4 mm


@pytest.mark.parametrize("rows", [1, 8])
def test_the_legend_stays_beside_the_panels_of_tall_charts(rows):
    figure = plotting.grid(rows)
    layout = figure.layout
    panels = layout.height - layout.margin.t - layout.margin.b
    assert (layout.legend.y - 1.0) * panels == pytest.approx(26.0)  # px


def test_every_label_of_a_large_matrix_is_shown_and_long_ones_are_cut():
    names = [f"thrust_loss of a motor with a rather long name {k}" for k in range(40)]
    figure = charts.confounding_matrix(names, np.eye(40))
    ticks = figure.layout.yaxis.ticktext
    assert len(ticks) == 40 == len(set(ticks)) and max(map(len, ticks)) <= 40
    assert figure.layout.height >= 40 * 14


def test_names_of_causes_are_words_outside_of_tables():
    names = ("low_end_loss.[fan=10in]", "drag", "zero_of_thrust")
    screened = SimpleNamespace(names=names, confounding=example().confounding)
    shown = dr.diagnosis_page(example(screened=screened, cannot_see={}))
    section = next(s for s in shown.sections if s.title == "What mimics what")
    assert section.text == ["These data hardly part low end loss (fan 10in) and zero of thrust."]
    (chart,) = section.content
    assert "zero of thrust" in chart.figure.layout.yaxis.ticktext


def test_long_lists_are_cut_and_counted():
    names = [f"torque_ratio[rotor={k}]" for k in range(9)] + [f"shape_{k}" for k in range(9)]
    base = tuple(BaseRow(n, n, "-", 1.0, 0.1, 0.9, 1.1, 1.0, 0.1, 0.0, 3.0) for n in names)
    text = next(
        s for s in dr.diagnosis_page(example(base=base)).sections if s.title.startswith("Base")
    ).text[0]
    assert text.startswith("These runs say nothing of torque ratio, shape 0,")
    assert text.endswith("and 4 more.")


def test_the_status_says_below_which_size_and_beside_which_rivals():
    size = {"x": Interval(0.2, 0.1, 0.3)}
    hidden = CauseRow("a", "a", "effect", "not visible below", 0.0, size, "m/s^2",
                      smallest_visible={"x": 0.0219, "y": 0.0187})  # fmt: skip
    likely = CauseRow("b", "b", "effect", "likely", 0.9, size, "N", rivals=("c", "d"))
    refuted = CauseRow("e", "e", "effect", "refuted", 0.0, size, "N", rivals=("b",))
    unjudged = CauseRow("f", "f", "effect", "not judged", None, {}, "N", note="three runs")
    shown = tables.causes(example(causes=(hidden, likely, refuted, unjudged)))
    rows = shown.rows
    assert [row[1] for row in rows] == [
        "not visible below 0.0187 to 0.0219 m/s^2",
        "likely; rivals: c, d",
        "refuted by b",
        "not judged",
    ]
    assert [row[2].replace("\xa0", " ") for row in rows] == ["–", "0.2 (0.1 to 0.3) N", "–", "–"]
    assert rows[3][6] == "needs three runs"
    assert shown.parts == [("", [1]), ("3 refuted, not visible or not judged", [0, 2, 3])]


def test_the_note_of_a_likely_cause_says_why_it_is_not_certain():
    why = ("the fit did not converge", "its derivative could not be confirmed")
    row = CauseRow("b", "b", "effect", "likely", 0.9, {}, "N", note="Force -size v.", doubts=why)
    (cells,) = tables.causes(example(causes=(row,))).rows
    assert cells[6] == (
        "Force -size v. Likely, not certain: the fit did not converge; "
        "its derivative could not be confirmed."
    )


def test_barely_outside_is_not_one_times():
    outside = (OutsideRow("b", "frequency of u", 0.413, 0.417, 0.711, 1.0004, "Hz"),)
    (row,) = tables.outside(outside)[0].rows
    assert row[-1] == "barely"


def test_what_does_not_apply_does_not_pass():
    gate = GateResult(name="repeats", passed=True, value=0, limit=1, applies=False)
    shown = dr.diagnosis_page(example(gates=(gate,)))
    (table,) = next(s for s in shown.sections if s.title.startswith("Checks")).content
    assert table.rows[0][1] == "does not apply"


def test_a_cause_with_a_size_is_not_listed_as_invisible():
    shown = dr.diagnosis_page(example(cannot_see={"delay": "below 6.6e9 s", "tilt": "no trace"}))
    section = next(s for s in shown.sections if s.title.startswith("What these data cannot see"))
    cells = [row[0] for table in section.content for row in table.rows]
    assert "delay" not in cells and "tilt" in cells


def test_outside_of_what_was_fitted_is_said():
    shown = dr.diagnosis_page(example())
    table = next(s for s in shown.sections if s.title.startswith("Error on runs")).content[1]
    assert table.rows == [["b", "amplitude of pull_N", "1.5 N", "-1 to 1", "1.5 times"]]


def test_only_the_farthest_outside_are_shown_and_the_rest_is_counted():
    far = tuple(
        OutsideRow("b", f"stroke of x{k}", 9.0 - k, 0.0, 1.0, 9.0 - k / 2) for k in range(14)
    )
    shown = dr.diagnosis_page(example(outside=far))
    table = next(s for s in shown.sections if s.title.startswith("Error on runs")).content[1]
    assert [row[1] for row in table.rows] == [f"stroke of x{k}" for k in range(10)]
    assert "4 more lie outside" in table.caption


def test_what_is_missing_is_said():
    page_ = dr.diagnosis_page(
        example(
            runs=RUNS[:1], next_run=None, gain=None, rivals=(),
            screened=SimpleNamespace(names=(), confounding=np.eye(0)),
        )
    )  # fmt: skip
    words = " ".join(t for section in page_.sections for t in section.text)
    for said in ("no gain is known", "No force map", "No candidate", "Nothing is open"):
        assert said in words


def test_what_is_left_open_leads_to_the_next_run():
    sections = {s.title: s.text for s in dr.diagnosis_page(example(next_run=None)).sections}
    assert "diffsim diagnose next" in sections["Which run to record next"][0]


def test_force_map_takes_its_place():
    sections = {s.title: s for s in dr.diagnosis_page(example(force_map=FORCE)).sections}
    (picture,) = sections["Where a force is missing"].content
    assert "unknown force" in picture.caption


def test_blocks_are_linked_by_the_size_of_the_cosine():
    cosines = np.eye(5)
    for i, j, value in ((0, 3, -0.99), (3, 4, 0.96), (1, 2, 0.94)):
        cosines[i, j] = cosines[j, i] = value
    assert series.blocks_of(cosines) == [[0, 3, 4]]


def test_boxes_surround_the_blocks():
    names = list("abcde")
    cosines = np.eye(5)
    cosines[1, 4] = cosines[4, 1] = 0.99
    figure = charts.confounding_matrix(names, cosines)
    assert list(figure.layout.xaxis.ticktext) == ["b", "e", "a", "c", "d"]
    (box,) = figure.layout.shapes
    assert (box.x0, box.x1, box.y0, box.y1) == (-0.5, 1.5, -0.5, 1.5)


def test_spectrum_of_white_noise_is_one_and_finds_a_tone():
    rng = np.random.default_rng(0)
    t = np.arange(400) * 0.01
    noise = rng.normal(size=(400, 50))
    _, power = series.mean_periodogram([(t, noise)])
    assert abs(power.mean() - 1.0) < 0.03  # 200 x 50 values of a chi2 with two freedoms
    tone = noise + 2.0 * np.sin(2.0 * np.pi * 12.5 * t)[:, None]
    frequency, power = series.mean_periodogram([(t, tone)])
    assert frequency[power.argmax()] == pytest.approx(12.5)


def test_phase_turns_once_per_period_and_steps_have_none():
    t = np.linspace(0.0, 2.0, 400, endpoint=False)
    phase = series.command_phase(t, 5.0 + np.cos(2.0 * np.pi * t))
    assert phase is not None
    error = np.angle(np.exp(1j * (phase - 2.0 * np.pi * t)))
    assert np.abs(error[2:-2]).max() < 0.01  # differences at the ends are one-sided
    assert series.command_phase(t, np.repeat([1.0, 2.0], 200)) is None


def test_the_page_shows_the_report():
    sizes = {"x": Interval(0.1, 0.08, 0.12), "y": Interval(0.2, 0.15, 0.25)}
    tilt = CauseRow("tilt", "a tilt", "effect", "certain", 0.999, sizes, "rad", gain=GAIN)
    report = example(causes=(tilt,), named=("tilt",))
    shown = dr.diagnosis_page(report)
    tables = [c for s in shown.sections for c in s.content if isinstance(c, page.Table)]
    causes = next(t for t in tables if t.caption.startswith("Probability"))
    assert [causes.rows[0][k] for k in (0, 1, 3)] == ["a tilt\ntilt", "certain", "1.00"]
    sizes = causes.rows[0][2].replace("\xa0", " ").split("\n")
    assert sizes == ["x: 0.1 (0.08 to 0.12) rad", "y: 0.2 (0.15 to 0.25) rad"]
    assert causes.rows[0][4] == "0.97 (0.93 to 0.99)"
    base = next(t for t in tables if t.caption.startswith("Pull"))
    assert base.rows[0] == ["gain", "a", "1.4 (1.37 to 1.43)", "1 ± 0.1", "–", "+4.0"]
    assert list(base.emphasis) == [0]
    fixed = dr.held_fixed(report)
    assert fixed["fitted"] == "a; 1 nuisances of single runs"
    assert fixed["taken from the study"] == ["geometry"]
    white = next(t for t in tables if "Ljung" in t.caption)
    assert len(white.columns) == 3 and white.rows[0][1] == "< 0.001"  # the model leads
    runs = series.predicted_runs(report.study, report.null, report.best)
    np.testing.assert_array_equal(runs[0].null, RUNS[0].null)
    np.testing.assert_array_equal(runs[1].extended, RUNS[1].extended)
    assert [c.sd for c in series.with_noise(CHANNELS, {"tip_z_m": 2e-4, "tip_x_m": 3e-4})] == [
        2e-4,
        3e-4,
    ]


def test_residuals_stand_over_the_place_and_whiteness_is_shown(tmp_path):
    text = dr.write_diagnosis(example(channels=PLACED), tmp_path / "a.html").read_text("utf-8")
    plain = dr.write_diagnosis(example(), tmp_path / "b.html").read_text("utf-8")
    assert text.count("Plotly.newPlot") == 1 + plain.count("Plotly.newPlot")
    assert "Shown, not used" in text


def test_rms_over_position_rises_where_the_model_is_off():
    t = np.linspace(0.0, 1.0, 200)
    left = np.where(t > 0.8, 5.0, 1.0)[:, None]
    middle, rms = series.binned_rms(t, left)
    assert (np.diff(middle) > 0).all()
    np.testing.assert_allclose(rms, [1.0] * 8 + [5.0] * 2)


def test_settings_are_said_in_lines_not_brackets():
    pairs = dict(dr._pairs({"keep_nats": 4.0, "failed": [], "search": {"max_effects": 3}}))
    assert pairs == {"keep nats": "4.0", "failed": "none", "search: max effects": "3"}


def test_force_map_has_a_row_per_shape_and_a_column_per_knot():
    names = ("north_0", "north_1", "down_0", "down_1")
    z = np.array([[0.1, 0.2, 0.0, 0.3], [9.0, 1.0, 0.5, -4.0]])
    figure = charts.force_map(names, ("calm", "pushed"), z)
    calm, pushed = figure.data
    assert [list(row) for row in pushed.z] == [[9.0, 1.0], [0.5, -4.0]]
    assert list(pushed.y) == ["north", "down"]
    assert (calm.zmin, calm.zmax) == (-9.0, 9.0) == (pushed.zmin, pushed.zmax)
    assert (calm.visible, pushed.visible) == (True, False)


class Swinging(SimModel):
    """A ball where the two channels say."""

    def shape_of(self, run, channels):
        ball = mesh.surface_triangles(mesh.hex_box((2, 2, 2), (0.002,) * 3))
        nodes = mesh.hex_box((2, 2, 2), (0.002,) * 3).nodes.numpy()
        place = np.zeros((len(channels), 1, 3))
        place[:, 0, [2, 0]] = channels.numpy()
        return MovingShape(triangles=ball.faces.numpy(), nodes_m=nodes + place)


def moving_example(runs=RUNS) -> Report:
    report = example(runs)
    for fit in (report.null, report.best):
        fit.problem.model = Swinging(lambda *_: None, (), "ball")
    return report


def test_what_moves_is_shown_measured_before_and_after():
    measured = RUNS[1].measured.copy()
    measured[40:43] = np.nan  # nothing is known there
    runs = (RUNS[0], replace(RUNS[1], measured=measured))
    view = moving_runs(moving_example(runs), runs[1:])
    assert view is not None and list(view.views) == ["b"]
    shown = view.views["b"]
    assert [p.name for p in shown.parts] == ["measured", "model before", "extended model"]
    kept = [int(np.abs(runs[1].time_s - t).argmin()) for t in shown.time_s]
    assert not set(kept) & {40, 41, 42} and np.diff(shown.time_s).min() > 0.5 / 25.0
    for part, record in zip(shown.parts, (measured, runs[1].null, runs[1].extended), strict=True):
        heights = part.nodes_m[:, :, 2].min(1)
        np.testing.assert_allclose(heights, record[kept, 0] + heights[0] - record[kept[0], 0])


def test_models_that_show_more_than_channels_are_simulated():
    """Of a rod only markers are measured; the fits are drawn with its skin."""
    skin = np.array([[0, 1, 2], [0, 2, 3]])

    report = moving_example()
    for fit in (report.null, report.best):
        fit.problem.shape_at = lambda run, x: MovingShape(
            triangles=skin, nodes_m=np.zeros((len(run.time_s), 4, 3))
        )
    at = {"null_at": report.null.x, "extended_at": report.best.x}
    view = moving_runs(report, [replace(RUNS[1], **at)])
    assert view is not None
    measured, before, after = view.views["b"].parts
    assert len(measured.triangles) > 2
    np.testing.assert_array_equal(before.triangles, skin)
    np.testing.assert_array_equal(after.triangles, skin)


def test_a_model_that_shows_nothing_has_no_view():
    assert moving_runs(example(), RUNS) is None


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_browser_turns_what_moves_and_chooses_the_run(tmp_path):
    runs = (*RUNS, comparison("c", "test", 0.05, 3))
    path = dr.write_diagnosis(moving_example(runs), tmp_path / "report.html")
    assert path.stat().st_size < 3_000_000
    with Browser(tmp_path / "profile") as browser:
        browser.open(path)
        browser.until("document.querySelectorAll('.moving canvas').length === 1")
        box = "document.querySelector('.moving')"
        drawn = int(browser.js(f"{box}.dataset.drawn"))
        pixels = f"{box}.querySelector('canvas').toDataURL()"
        first = browser.js(pixels)
        x, y = browser.middle(".moving canvas")
        browser.drag((x, y), (x + 90, y + 20))
        assert browser.js(pixels) != first
        pressed = f"{box}.querySelector('.moving-part').getAttribute('aria-pressed')"
        browser.js(f"{box}.querySelector('.moving-part').click()")  # measured
        assert int(browser.js(f"{box}.dataset.drawn")) == drawn * 2 // 3
        before = browser.js(pixels)
        menu = f"{box}.querySelector('select')"
        assert browser.js(f"[...{menu}.options].map(o => o.text)") == ["b", "c"]
        browser.js(f"{menu}.selectedIndex = 1; {menu}.dispatchEvent(new Event('change'))")
        browser.js(f"{box}.querySelector('input').value = 20")
        browser.js(f"{box}.querySelector('input').dispatchEvent(new Event('input'))")
        assert browser.js(f"{box}.dataset.frame") == "20" and browser.js(pixels) != before
        assert browser.js(pressed) == "false"  # what was hidden stays so
        assert browser.complaints == []
        browser.middle(".moving canvas")
        browser.picture(tmp_path / "moving.png")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_browser_toggles_the_cause_and_zooms_a_curve(tmp_path):
    runs = (*RUNS, comparison("c", "test", 0.05, 3))
    path = dr.write_diagnosis(example(runs), tmp_path / "report.html")
    with Browser(tmp_path / "profile") as browser:
        browser.open(path)
        browser.until("document.querySelectorAll('.main-svg .legend').length >= 1")
        browser.until("document.querySelectorAll('.plotly-graph-div.js-plotly-plot').length === 4")
        plot = "document.querySelector('.plotly-graph-div')"
        names = browser.js(f"{plot}._fullData.filter(d => d.showlegend).map(d => d.name)")
        cause = names.index("extended model")  # the model with the cause that was named
        shown = f"{plot}._fullData.filter(d => d.name === 'extended model')[0].visible"
        assert browser.js(shown) is True
        toggles = f"{plot}.querySelectorAll('.legendtoggle')"
        browser.js(f"{toggles}[{cause}].id = 'cause'")
        browser.click("#cause")
        browser.until(f"{shown} === 'legendonly'")
        across = f"{plot}._fullLayout.xaxis.range"
        wide = browser.js(across)
        x, y = browser.middle(".plotly-graph-div .nsewdrag")
        browser.drag((x - 60, y - 15), (x + 60, y + 15))
        browser.until(f"{across}[1] - {across}[0] < {0.7 * (wide[1] - wide[0])}")
        menu = "document.querySelector('.chart select')"
        assert browser.js(f"[...{menu}.options].map(o => o.text)") == ["b (test)", "c (test)"]
        browser.js(f"{menu}.selectedIndex = 1; {menu}.dispatchEvent(new Event('change'))")
        lead = f"{plot}._fullData[0].y[0]"  # of the model before
        browser.until(f"Math.abs({lead} - {runs[2].null[0, 0]:.9f}) < 1e-6")
        assert browser.js(f"{plot}.data.length") == 2 * 5  # of the chosen run alone
        assert browser.js(shown) == "legendonly"  # what was hidden stays so
        assert browser.js(across) == pytest.approx(wide, abs=0.1)  # and all of it is seen
        assert browser.complaints == []
        browser.picture(tmp_path / "page.png")


def test_a_column_without_a_name_has_no_colon_on_a_phone(tmp_path):
    table = page.Table(columns=["what", ""], rows=[["form", "table"]])
    section = page.Section(title="Law", content=[table])
    content = page.Report(title="t", subtitle="s", verdict=["v"], numbers=[], sections=[section])
    text = page.write(content, tmp_path / "page.html").read_text(encoding="utf-8")
    assert 'data-label="">table' in text and ':not([data-label=""])::before' in text
