"""The page of a diagnosis: all of its parts, in order, and figures that show what they say."""

from __future__ import annotations

import types

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="reports need pip install 'diffsim-robot[viz]'")
pytest.importorskip("jinja2", reason="reports need pip install 'diffsim-robot[viz]'")

from diffsim.identify import WhiteNoise
from diffsim.viz import diagnosis_content as dc
from diffsim.viz import diagnosis_figures as draw
from diffsim.viz import diagnosis_report as dr
from diffsim.viz import report as page
from diffsim.viz.diagnosis_figures import MeasuredChannel, RunComparison

CHANNELS = (
    MeasuredChannel(name="tip_z_m", unit="m", sd=1e-4),
    MeasuredChannel(name="tip_x_m", unit="m", sd=1e-4),
)


def comparison(name: str, use: str, lag: float, seed: int) -> RunComparison:
    """A made-up swing that the model before leads by ``lag`` [s]."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 3.0, 150)
    truth = np.stack([4e-3 * np.sin(6.0 * t), 1e-3 * np.cos(6.0 * t)], -1)
    early = np.stack([4e-3 * np.sin(6.0 * (t + lag)), 1e-3 * np.cos(6.0 * (t + lag))], -1)
    return RunComparison(
        name=name,
        use=use,
        time_s=t,
        command={"pull_N": np.sin(6.0 * t)},
        measured=truth + 1e-4 * rng.normal(size=truth.shape),
        null=early,
        extended=truth,
    )


def example(**changes) -> dc.DiagnosisFigures:
    runs = [comparison("a", "fit", 0.02, 1), comparison("b", "holdout", 0.03, 2)]
    rows = [
        dc.CauseRow(
            name="delay", status="named", size=0.021, sd=0.001, unit="s", nats=212.4,
            gain=(0.97, 0.93, 0.99), share=0.98, aliases=("clock offset",), smallest_visible=0.002,
        ),
        dc.CauseRow(
            name="lag <b>", status="rival", size=0.02, sd=0.002, unit="s", nats=-3.0,
            smallest_visible=0.003,
        ),
        dc.CauseRow(name="drag", status="screened", size=0.0, sd=np.nan, unit="-", note="small"),
    ]  # fmt: skip
    settings = {
        "study": "swing",
        "model": "beam",
        "verdict": "named",
        "sentences": ["The command acts 21 ± 2 ms late.", "It explains 98 % of the misfit."],
        "channels": CHANNELS,
        "runs": runs,
        "causes": rows,
        "confounding_names": ["delay", "drag", "lag <b>"],
        "confounding": np.array([[1.0, 0.1, 0.97], [0.1, 1.0, -0.2], [0.97, -0.2, 1.0]]),
        "cannot_see": {"tilt": "leaves no trace"},
        "gates": [dc.GateRow(name="mesh", passed=False, value=3.1, limit=2.0, note="lambda")],
        "rivals": [("lag <b>",)],
        "gain": (0.97, 0.93, 0.99),
        "chi2_null": 5000.0,
        "chi2_best": 303.0,
        "num_samples": 300,
        "next_run": ("hold and release", {"hold and release": 1258.0, "sine": 2.0}, 600.0),
        "settings": {"seed": 3},
    }
    return dc.DiagnosisFigures(**{**settings, **changes})


def test_page_has_its_parts_in_order(tmp_path):
    text = dr.write_diagnosis(example(), tmp_path / "report.html").read_text("utf-8")
    parts = [
        "The command acts 21",
        "on runs that no fit has seen",
        "Where and when the model is off",
        "Where a force is missing",
        "Candidate causes, by evidence",
        "What mimics what",
        "What these data cannot see",
        "Which run to record next",
        "Checks before physics is blamed",
        "Held fixed",
    ]
    places = [text.find(part) for part in parts]
    assert min(places) > 0 and places == sorted(places)
    assert "0.021 ± 0.00164 s" in text and "hold and release" in text and "FAILED" in text
    assert "lag &lt;b&gt;" in text and "lag <b>" not in text  # escaped
    assert text.count("data:image/png") == 4 and "http" not in text.replace("http-equiv", "")


def test_what_is_missing_is_said():
    runs = [comparison("a", "fit", 0.02, 1)]
    page_ = dr.diagnosis_page(
        example(runs=runs, next_run=None, gain=None, confounding_names=[], confounding=np.eye(0))
    )
    words = " ".join(t for section in page_.sections for t in section.text)
    for said in ("no held-out run", "No force map", "No candidate", "No advice"):
        assert said in words


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"verdict": "nmed"}, "verdict must be one of .*did you mean 'named'"),
        ({"confounding": np.eye(2)}, r"confounding must have shape \(3, 3\)"),
        ({"channels": CHANNELS[:1]}, r"run a: measured must have shape \(150, 1\)"),
    ],
)
def test_mistakes(changes, message):
    with pytest.raises(ValueError, match=message):
        example(**changes)


def test_force_map_takes_its_place():
    picture = page.Picture(uri="data:image/png;base64,AAAA", caption="wrench")
    sections = {s.title: s for s in dr.diagnosis_page(example(force_map=picture)).sections}
    assert sections["Where a force is missing"].content == [picture]


def test_worst_channel_first():
    assert draw.worst_channels(example().runs, CHANNELS) == [0, 1]
    quiet = (MeasuredChannel(name="z", unit="m", sd=1.0), CHANNELS[1])
    assert draw.worst_channels(example().runs, quiet) == [1, 0]


def test_blocks_are_linked_by_the_size_of_the_cosine():
    cosines = np.eye(5)
    for i, j, value in ((0, 3, -0.99), (3, 4, 0.96), (1, 2, 0.94)):
        cosines[i, j] = cosines[j, i] = value
    assert draw.blocks_of(cosines) == [[0, 3, 4]]


def test_boxes_surround_the_blocks():
    names = list("abcde")
    cosines = np.eye(5)
    cosines[1, 4] = cosines[4, 1] = 0.99
    (ax, _) = draw.confounding_matrix(names, cosines).axes
    assert [t.get_text() for t in ax.get_xticklabels()] == ["b", "e", "a", "c", "d"]
    (box,) = ax.get_lines()
    assert box.get_xdata().min() == -0.5 and box.get_xdata().max() == 1.5


def test_spectrum_of_white_noise_is_one_and_finds_a_tone():
    rng = np.random.default_rng(0)
    t = np.arange(400) * 0.01
    noise = rng.normal(size=(400, 50))
    _, power = draw.mean_periodogram([(t, noise)])
    assert abs(power.mean() - 1.0) < 0.03  # 200 x 50 values of a chi2 with two freedoms
    tone = noise + 2.0 * np.sin(2.0 * np.pi * 12.5 * t)[:, None]
    frequency, power = draw.mean_periodogram([(t, tone)])
    assert frequency[power.argmax()] == pytest.approx(12.5)


def test_phase_turns_once_per_period_and_steps_have_none():
    t = np.linspace(0.0, 2.0, 400, endpoint=False)
    phase = draw.command_phase(t, 5.0 + np.cos(2.0 * np.pi * t))
    assert phase is not None
    error = np.angle(np.exp(1j * (phase - 2.0 * np.pi * t)))
    assert np.abs(error[2:-2]).max() < 0.01  # differences at the ends are one-sided
    assert draw.command_phase(t, np.repeat([1.0, 2.0], 200)) is None


def test_filled_from_a_report():
    """Field by field from the shape of ``diffsim.diagnose.Report``."""
    space = types.SimpleNamespace
    run = comparison("a", "fit", 0.02, 1)
    gain = space(value=0.9, low=0.8, high=0.95)

    def fit(predicted):
        import torch

        problem = space(
            predict=lambda run, x: torch.from_numpy(predicted) * x[0],
            runs=(run,),
            whitener=WhiteNoise(CHANNELS),
        )
        left = problem.whitener.matrix(run) @ (run.measured - predicted + 1e-5).ravel()
        return space(problem=problem, x=np.array([1.0]), residual=left)

    row = space(
        effect="tilt", status="named", size={"x": 0.1, "y": 0.2}, sd={"x": 0.01, "y": 0.02},
        unit="rad", nats=9.0, gain=gain, share=0.7, aliases=("current",), note="",
        smallest_visible={"x": 0.03, "y": 0.04},
    )  # fmt: skip
    source = example()
    force = space(
        name="unknown force",
        groups=("calm", "pushed"),
        components=("north_0", "north_1", "down_0", "down_1"),
        z=np.array([[0.1, 0.2, 0.0, 0.3], [9.0, 1.0, 0.5, -4.0]]),
    )
    report = space(
        study=space(
            name="s", channels=CHANNELS, fit_runs=(run,), holdout_runs=(), metadata={"geometry": {}}
        ),
        model=space(name="m", base=(space(name="a"), space(name="offset@a"))),
        verdict="named",
        sentences=("It is tilted.",),
        named=("tilt",),
        rivals=(),
        table=(row,),
        confounding_names=source.confounding_names,
        confounding=source.confounding,
        cannot_see={},
        gates=(),
        noise={
            "sd": {"tip_z_m": 2e-4, "tip_x_m": 3e-4},
            "source": ("repeats", "repeats"),
            "num_spikes": 2,
        },
        gain=gain,
        chi2_null=9.0,
        chi2_best=3.0,
        num_samples=3,
        settings={},
        null=fit(run.null),
        best=fit(run.measured),
        next_run={"best": "a", "chi2_gain": {"a": 4.0}, "over_median": 1.0},
        force_map=force,
    )
    found = dc.figures_of(report)
    assert [c.name for c in found.causes] == ["tilt.x", "tilt.y"]
    assert found.causes[1].smallest_visible == 0.04 and found.gain == (0.9, 0.8, 0.95)
    assert [c.sd for c in found.channels] == [2e-4, 3e-4]
    np.testing.assert_array_equal(found.runs[0].null, run.null)
    np.testing.assert_array_equal(found.runs[0].extended, run.measured)
    assert found.settings["fitted"] == "a; 1 nuisances of single runs"
    assert found.settings["taken from the study"] == ["geometry"]
    assert len(found.whiteness) == 2 and found.whiteness[0][0] < 0.01  # the model leads
    assert found.force_map is not None and "unknown force" in found.force_map.caption
    assert page.render(dr.diagnosis_page(found)).count("tilt.x") >= 2


def test_residuals_stand_over_the_place_and_whiteness_is_shown(tmp_path):
    placed = [MeasuredChannel(name=c.name, unit="m", sd=c.sd, kind="position") for c in CHANNELS]
    more = {"channels": placed, "whiteness": [[0.001, 0.4], [0.3, float("nan")]]}
    text = dr.write_diagnosis(example(**more), tmp_path / "report.html").read_text("utf-8")
    assert text.count("<img") == 1 + example_images(tmp_path)
    assert "Shown, not used" in text and "0.001" in text


def example_images(folder) -> int:
    """Pictures of the example, whose channels have no kind."""
    return dr.write_diagnosis(example(), folder / "plain.html").read_text("utf-8").count("<img")


def test_rms_over_position_rises_where_the_model_is_off():
    t = np.linspace(0.0, 1.0, 200)
    left = np.where(t > 0.8, 5.0, 1.0)[:, None]
    middle, rms = draw._binned_rms(t, left)
    assert (np.diff(middle) > 0).all()
    np.testing.assert_allclose(rms, [1.0] * 8 + [5.0] * 2)


def test_settings_are_said_in_lines_not_brackets():
    pairs = dict(dr._pairs({"keep_nats": 4.0, "failed": [], "search": {"max_effects": 3}}))
    assert pairs == {"keep nats": "4.0", "failed": "none", "search: max effects": "3"}


def test_force_map_has_a_row_per_shape_and_a_column_per_knot():
    names = ("north_0", "north_1", "down_0", "down_1")
    z = np.array([[0.1, 0.2, 0.0, 0.3], [9.0, 1.0, 0.5, -4.0]])
    figure = draw.force_map(names, ("calm", "pushed"), z)
    calm, pushed = figure.axes[:2]
    np.testing.assert_array_equal(pushed.images[0].get_array(), [[9.0, 1.0], [0.5, -4.0]])
    assert [t.get_text() for t in pushed.get_yticklabels()] == ["north", "down"]
    assert calm.images[0].get_clim() == (-9.0, 9.0) == pushed.images[0].get_clim()
