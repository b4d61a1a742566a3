"""``diffsim diagnose judge``: a frozen model on runs that the diagnosis did not have."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from diffsim import cli
from diffsim.cli.diagnose_files import file_name, write_judged
from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.data import save_study
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.diagnose.judge.own_values import held_out_residual
from diffsim.diagnose.judge.records import ErrorRow, OutsideRow, no_skill_words
from diffsim.diagnose.judge.rivals import beside_no_skill
from diffsim.diagnose.judge.unseen import Unseen
from diffsim.diagnose.refit import extend, fit_null
from diffsim.identify import DiagnosisSetup, Numerics, fit, save_extended
from diffsim.identify.fitting import summary
from diffsim.identify.model_file import MODEL_FILE, SavedModel, read_extended, rebuilt
from tests.diagnose import toy, toy_setup

SETUP = str(Path(toy_setup.__file__))
TRUTH = {"drag": 0.2}


@pytest.fixture(scope="module")
def study():
    return toy.generate(2, TRUTH)


@pytest.fixture(scope="module")
def model_folder(study, tmp_path_factory):
    """An extended model, without a search."""
    out = tmp_path_factory.mktemp("model")
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    drag = SavedModel(out, {"drag": 0.2}, {}, (), ("drag",), "named")
    extend(inputs, drag).save(out)
    return out


def test_extend_twice_is_extend_once(study, model_folder, tmp_path):
    """Begun at its own end, a fit moved in the last digits."""
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    extend(inputs, read_extended(model_folder)).save(tmp_path)
    assert (tmp_path / MODEL_FILE).read_bytes() == (model_folder / MODEL_FILE).read_bytes()
    extend(inputs, read_extended(tmp_path)).save(tmp_path)
    for name in (MODEL_FILE, "extend.json"):
        assert (tmp_path / name).read_bytes() == (model_folder / name).read_bytes()


def test_extend_does_not_end_above_its_start_under_the_noise_of_the_file(study, model_folder):
    """Priors pull along valleys: what a diagnosis had reached was lost by a refit."""
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    saved = replace(read_extended(model_folder), path=Path("elsewhere.yaml"))
    problem, fitted = (found := extend(inputs, saved).fit).problem, found.chi2
    slopes, weak = found.jacobian, 0.1  # of the priors
    curve = slopes.T @ slopes + weak * np.eye(len(found.x))
    x = found.x + np.linalg.solve(curve, slopes.T @ found.residual - weak * found.x)
    lower = summary(problem, x, *problem.linearize(x), "converged", "", 0)
    assert lower.chi2 < fitted
    assert extend(inputs, replace(saved, values=lower.values)).fit.chi2 <= lower.chi2 + 1e-9
    doubled = {c: {**n, "sd": 2.0 * n["sd"]} for c, n in saved.facts["noise"].items()}
    facts = {**saved.facts, "noise": doubled}
    wide = extend(inputs, replace(saved, facts=facts))
    assert wide.fit.chi2 == pytest.approx(0.25 * fitted, rel=0.02)


@pytest.fixture(scope="module")
def new_folder(study, tmp_path_factory):
    """Another study of the same rig: one run, three times as large a command."""
    folder = tmp_path_factory.mktemp("new") / "study"
    held = study.test_runs[0]
    fresh = replace(held, name="fresh", group="fresh", setup={"payload_kg": 0.2})
    save_study(replace(study, name="later", runs=(fresh,)), folder)
    return folder


def judge(study, out, model, *more):
    folders = ["--out", str(out), "--model", str(model)]
    return cli.main(["diagnose", "judge", str(study), "--setup", SETUP, "--debug", *folders, *more])


def test_a_new_study_is_judged_and_nothing_is_fitted(model_folder, new_folder, tmp_path, capsys):
    before = (model_folder / "extended_model.yaml").read_bytes()
    assert judge(new_folder, tmp_path, model_folder) == 0
    said = capsys.readouterr().out
    assert "fresh" in said and "confirmed" in said and "2 values" in said
    found = json.loads((tmp_path / "judge.json").read_text())
    assert found["runs"] == ["fresh"]
    rows = {row["kind"]: row for row in found["errors"]}
    assert rows["position"]["noise"] == pytest.approx(0.03, rel=0.1)
    assert rows["position"]["after"] < 1.15 * rows["position"]["noise"]
    assert rows["position"]["before"] > 1.15 * rows["position"]["after"]
    assert rows["position"]["num_fitted"] == 2  # its offset and its gain, as declared
    assert found["gain"]["low"] > 0.5 and found["gains"]["fresh"] == found["gain"]
    assert (model_folder / "extended_model.yaml").read_bytes() == before
    assert found["headline"].startswith(
        "With the extended model the error on unseen runs falls from"
    )
    assert found["headline"] in (tmp_path / "judge.html").read_text("utf-8")
    lines = (tmp_path / "judged" / "fresh.csv").read_text().splitlines()
    names, table = lines[0].split(","), np.genfromtxt(lines[1:], delimiter=",")
    assert names[:4] == [
        "time_s",
        *(f"position_m {w} (m)" for w in ("measured", "before", "after")),
    ]
    run = load_study(new_folder).runs[0]
    np.testing.assert_allclose(table[:, :2], np.column_stack([run.time_s, run.measured[:, 0]]))
    left = table[:, [2, 3]] - table[:, [1]]
    said = [rows["position"]["before"], rows["position"]["after"]]
    np.testing.assert_allclose(np.sqrt(np.mean(left**2, axis=0)), said, rtol=1e-6)


def test_a_saved_model_judges_as_the_fits_do(model_folder, study):
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    saved = read_extended(model_folder)
    found = judge_saved(inputs, saved)
    null = fit_null(inputs)
    held = study.test_runs[0]
    excess = np.sum(held_out_residual(null.fit, held) ** 2) / held.measured.size - 1.0
    assert found.gain is not None
    assert found.gain.excess == pytest.approx(excess, rel=1e-3)


def test_how_far_outside_is_told(model_folder, new_folder, tmp_path):
    study = load_study(new_folder)
    run = study.runs[0]
    far = replace(run, command={"u": 3.0 * run.command["u"]}, setup={"payload_kg": 0.2})
    inputs = inputs_of(replace(study, runs=(far,)), seed=0, setup_file=Path(SETUP))
    rows = {row.what: row for row in judge_saved(inputs, read_extended(model_folder)).outside}
    largest = rows["level of u"]
    assert abs(largest.value) == pytest.approx(2.7, rel=0.01) and largest.high < 1.01
    middle, half = 0.5 * (largest.low + largest.high), 0.5 * (largest.high - largest.low)
    assert largest.times == pytest.approx(abs(largest.value - middle) / half, rel=1e-6)
    assert "fitted runs have" in largest.words
    assert f"{largest.times:.2g} times as far" in largest.words
    assert all(row.times > 1.0 for row in rows.values())


def test_what_was_fitted_proves_nothing(model_folder, study, tmp_path):
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    saved = read_extended(model_folder)
    with pytest.raises(ValueError, match="run chirp_a was used to fit the model"):
        judge_saved(inputs, saved, ["chirp_a"])
    renamed = replace(study.runs[0], name="new_name", use="test")
    inputs = inputs_of(replace(study, runs=(renamed,)), seed=0, setup_file=Path(SETUP))
    with pytest.raises(ValueError, match=r"run new_name was used to fit the model \(as chirp_a\)"):
        judge_saved(inputs, saved)
    with pytest.raises(ValueError, match="--runs must be one of"):
        judge_saved(inputs, saved, ["old_name"])


def test_runs_that_a_first_answer_left_out_are_called_so(study, model_folder):
    """Judged like tests, they passed for runs that nobody had meant to fit."""
    saved, run = read_extended(model_folder), study.fit_runs[0]
    seen = {name: k for name, k in saved.facts["seen_runs"].items() if name != run.name}
    saved = replace(saved, facts={**saved.facts, "seen_runs": seen})
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    found = judge_saved(inputs, saved, [run.name, study.test_runs[0].name])
    assert found.left_out == (run.name,) == tuple(found.to_dict()["left_out"])
    assert found.left_out_words == (
        "1 of 2 runs here have use: fit, but the saved model was not fitted to them: unseen, of "
        "kinds that were fitted."
    )
    new = OutsideRow(run.name, "payload_kg", 0.5, 0.1, 0.2, 7.0)
    assert replace(found, outside=(new,)).left_out_words.endswith("fitted to them: unseen.")
    assert not replace(found, left_out=()).left_out_words


def test_a_part_of_what_was_fitted_proves_nothing(model_folder, study):
    saved, fitted = read_extended(model_folder), study.fit_runs[0]
    half, held = len(fitted.time_s) // 2, study.test_runs[0]

    def part(begin, **facts):
        """A new record of which one half was fitted."""
        measured = held.measured.copy()
        measured[begin : begin + half] = fitted.measured[half : 2 * half]
        return replace(held, name="part", measured=measured, setup={**held.setup, **facts})

    for begin in (0, 3, half - 1):
        inputs = inputs_of(replace(study, runs=(part(begin),)), seed=0, setup_file=Path(SETUP))
        said = f"part holds at least .* samples of run {fitted.name}, which was used to fit"
        with pytest.raises(ValueError, match=said):
            judge_saved(inputs, saved)
    known = {**saved.facts["seen_runs"][fitted.name], "block_of": "video"}
    seen = {**saved.facts["seen_runs"], fitted.name: known}
    declared = replace(saved, facts={**saved.facts, "seen_runs": seen})
    one = replace(study, runs=(part(0, block_of="video"),))
    assert judge_saved(inputs_of(one, seed=0, setup_file=Path(SETUP)), declared).errors


def test_a_new_run_owes_nothing_to_a_fitted_one_of_the_same_name(model_folder, new_folder, study):
    later, saved = load_study(new_folder), read_extended(model_folder)
    fitted = study.fit_runs[0].name
    assert any(name.endswith(f"@{fitted}") for name in saved.values)
    errors = []
    for name in ("fresh", fitted):
        runs = tuple(replace(run, name=name) for run in later.runs)
        inputs = inputs_of(replace(later, runs=runs), seed=0, setup_file=Path(SETUP))
        errors.append([(row.before, row.after) for row in judge_saved(inputs, saved).errors])
    assert errors[0] == errors[1]


def test_refined_settings_are_those_of_the_saved_model(study, tmp_path):
    model, finer = toy.model(study.runs, 0.02), Numerics(time_step=0.5)
    runs, channels = study.fit_runs[:1], study.channels
    found = fit(model, runs, channels, numerics=finer)
    save_extended(found, tmp_path / "extended_model.yaml", study=study, verdict="named")
    saved = read_extended(tmp_path)
    assert saved.numerics == finer
    loaded = rebuilt(saved, DiagnosisSetup(model=model, effects=()))
    fitted = found.problem.predict(runs[0], torch.from_numpy(found.x))
    np.testing.assert_allclose(loaded.predict(runs[0], loaded.at_prior()), fitted, atol=1e-12)
    rough = replace(found.problem, numerics=None).predict(runs[0], torch.from_numpy(found.x))
    assert float((rough - fitted).abs().max()) > 1e-4


def test_a_file_without_the_plain_fit_is_refused(model_folder, new_folder, tmp_path):
    content = yaml.safe_load((model_folder / "extended_model.yaml").read_text())
    assert set(content["plain"]) == set(content["parameters"])
    del content["plain"]
    (tmp_path / "extended_model.yaml").write_text(yaml.safe_dump(content))
    inputs = inputs_of(load_study(new_folder), seed=0, setup_file=Path(SETUP))
    with pytest.raises(ValueError, match="holds no plain model to compare with"):
        judge_saved(inputs, read_extended(tmp_path))


def test_every_run_has_a_table_of_its_own():
    names = ["a/b", "a_b", "a\\b", "a%2Fb", "a b"]
    files = [file_name(name) for name in names]
    assert len(set(files)) == len(names) and files[1::3] == ["a_b", "a b"]
    assert not any(c in "".join(files) for c in "/\\")


def test_numbers_of_a_table_have_the_unit_that_its_header_says(study, tmp_path):
    run = study.test_runs[0]
    place, *others = study.channels
    shown = replace(study, channels=(replace(place, shown_unit="mm"), *others))
    said = {run.name: (run.measured, 2.0 * run.measured)}
    found = Unseen((run.name,), errors=(), gain=None, gains={}, outside=(), predicted=said)
    (path,) = write_judged(tmp_path, shown, found)
    header, *rows = (line.split(",") for line in path.read_text().splitlines())
    before, after = (
        next(i for i, name in enumerate(header) if f" {what} (mm)" in name)
        for what in ("before", "after")
    )
    table = np.array(rows, dtype=np.float64)
    np.testing.assert_allclose(table[:, before], 1e3 * run.measured[:, 0], rtol=1e-8)
    np.testing.assert_allclose(table[:, after], 2e3 * run.measured[:, 0], rtol=1e-8)


def test_what_is_fitted_to_a_run_is_shown_with_its_prior_and_the_error_without(
    model_folder, new_folder, tmp_path, capsys
):
    """A starfish's zero, stated 0 +- 0.5 mm, ended at 7.2 mm in a new run without a word."""
    study = load_study(new_folder)
    run = study.runs[0]
    moved = replace(run, measured=run.measured + np.array([0.2, 0.0]))  # ten times what is stated
    folder = tmp_path / "moved"
    save_study(replace(study, runs=(moved,)), folder)
    assert judge(folder, tmp_path, model_folder) == 0
    said = capsys.readouterr().out
    found = json.loads((tmp_path / "judge.json").read_text())
    offset, gain = (row for row in found["fitted"])
    assert (offset["name"], offset["prior_value"], offset["prior_sd"]) == ("offset@fresh", 0, 0.02)
    assert offset["value"] == pytest.approx(0.2, abs=0.03)
    assert offset["pull"] == pytest.approx(offset["value"] / 0.02)
    assert gain["name"] == "gain_factor@fresh" and abs(gain["pull"]) < 3.0
    row = next(row for row in found["errors"] if row["kind"] == "position")
    assert row["without"] == pytest.approx(np.hypot(0.2, 0.03), rel=0.2)
    assert row["without"] > 5.0 * row["after"]
    assert "fitted to fresh: offset" in said and "gain factor" in said
    assert "Run fresh was fitted far from what the study states: offset" in said
    assert "sd off." in said and "stated 0 +- 0.02 m" in said
    assert ">offset</td>" in (tmp_path / "judge.html").read_text("utf-8")


def test_a_study_of_test_runs_alone_asks_for_a_model(new_folder, tmp_path, capsys):
    study = load_study(new_folder)
    folder = tmp_path / "alone"
    save_study(replace(study, runs=tuple(replace(r, use="test") for r in study.runs)), folder)
    given = ["diagnose", "judge", str(folder), "--setup", SETUP, "--out", str(tmp_path / "none")]
    assert cli.main(given) != 0
    said = capsys.readouterr()
    assert "has no run with use: fit" in said.err + said.out
    assert "--model FOLDER/extended_model.yaml" in said.err + said.out


def test_each_cause_and_each_kind_of_run_is_judged(model_folder, new_folder, tmp_path, capsys):
    """One half of the runs is of another rig, whose drag the model has twice."""
    study = load_study(new_folder)
    fresh, channel = study.runs[0], study.channels[0]
    saved = read_extended(model_folder)
    assert saved.components == ("drag",)
    inputs = inputs_of(study, seed=0, setup_file=Path(SETUP))
    plain, extended = judge_saved(inputs, saved).predicted["fresh"]
    noise = channel.sd * np.random.default_rng(0).normal(size=(len(plain), 3))
    as_said = {"fresh_1": extended, "fresh_2": extended, "heavy_1": 2.0 * plain - extended}
    runs = []
    for k, (name, record) in enumerate(as_said.items()):
        measured = fresh.measured.copy()
        measured[:, 0] = record[:, 0] + noise[:, k]
        runs.append(replace(fresh, name=name, group=name, measured=measured))
    folder = tmp_path / "both"
    save_study(replace(study, runs=tuple(runs)), folder)
    assert judge(folder, tmp_path, model_folder) == 0
    said = capsys.readouterr().out
    found = json.loads((tmp_path / "judge.json").read_text())
    assert found["headline"].startswith("Better on fresh (2 of 2), worse on heavy.")
    assert len(found["headline"].partition(". ")[0].split()) <= 25
    assert said.index("Run fresh_1: ") < said.index("On unseen runs")
    assert found["kinds"]["fresh"]["low"] > 0.0 > found["kinds"]["heavy"]["high"]
    # its one cause taken out is not the plain model, whose mass is another
    (without,) = found["causes"].values()
    left = {(row["run"], row["kind"]): row["before"] for row in without["errors"]}
    whole = {(row["run"], row["kind"]): row["after"] for row in found["errors"]}
    assert left["fresh_1", "position"] > 1.2 * whole["fresh_1", "position"]
    assert "drag" in said.split("On unseen runs")[1]
    # the zero of a position is free: so is a constant's
    rows = [row for row in found["errors"] if row["kind"] == "position"]
    for row, run in zip(rows, runs, strict=True):
        assert row["constant"] == pytest.approx(np.std(run.measured[:, 0]), rel=0.02)


def test_a_command_that_is_the_answer_leaves_no_skill_to_the_model():
    time = np.linspace(0.0, 4.0, 401)
    goal = np.sin(3.0 * time)
    late = np.interp(time - 0.25, time, goal) + 0.3
    run = Run("a", time, late[:, None], {"goal": goal}, "a", use="test")
    channels = (Channel("angle", "rad", "angle", sd=0.01),)
    study = Study("servo", "ode", channels, (run,), commands=(Command("goal", unit="rad"),))
    row = ErrorRow("a", "angle", "rad", 0.5, 0.2, 0.01, 401, 0)
    found = Unseen(("a",), errors=(row,), gain=None, gains={}, outside=())
    (row,) = beside_no_skill(found, study)
    assert row.command == pytest.approx(0.0, abs=1e-3) and row.constant is None
    assert "the command itself, late and shifted, would leave" in no_skill_words([row])[0]
    other = replace(study, commands=(Command("goal", unit="N"),))
    assert beside_no_skill(found, other)[0].command is None
