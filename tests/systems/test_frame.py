"""Causes of a saved model on new runs: they mean what they meant where the model was fitted."""

from dataclasses import replace

import pytest

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.identify.model_file import read_extended
from diffsim.systems import setup_of
from tests.diagnose.discover.answers import answer
from tests.systems.test_bench_description import NOISE, bench


def _fast_bench():
    return bench(runs=(("A", "fit"), ("B", "fit"), ("C", "fit"), ("B", "test")))


def test_an_unseen_propeller_tells_its_own_coefficient(tmp_path):
    """Its name has a dot, its coefficient is 8 prior sd off: only the law's exponent is known."""
    study = bench(lambda w: 1e-5 * w**2 * (w / 500.0) ** 0.12)
    report = answer(study)
    assert "exponent_of_thrust" in report.named
    report.save(tmp_path)
    saved = read_extended(tmp_path)
    fresh = bench(
        lambda w: 1e-5 * w**2 * (w / 500.0) ** 0.12,
        runs=(("9x4.5", "test"),),
        scales={"9x4.5": 12.0},
        seed=3,
    )
    judged = judge_saved(inputs_of(saved.framed(fresh), seed=0), saved)
    (row,) = judged.errors
    assert row.num_fitted == 1 and row.unit == "N"
    assert row.before > 20.0 * NOISE and row.after < 0.25 * row.before
    assert any("no fitted run has propeller 9x4.5" in far.words for far in judged.outside)


def test_a_components_label_may_have_dots(tmp_path):
    runs = (("5x4.5", "fit"), ("5x3.0", "fit"), ("6x4.5", "fit"), ("5x4.5", "test"))
    report = answer(bench(lambda w: 1e-5 * w**2 * (w / 500.0) ** 0.12, runs=runs, scales={}))
    report.save(tmp_path)
    study: Study = bench(runs=(("5x4.5", "test"),), scales={}, seed=7)
    saved = read_extended(tmp_path)
    judged = judge_saved(inputs_of(saved.framed(study), seed=0), saved)
    assert judged.runs == ("5x4.5_0",)


def test_a_drift_from_run_to_run_needs_three_runs():
    study = bench(runs=(("A", "fit"), ("B", "fit")))
    setup = setup_of(study)
    report = diagnose(study, setup.model, setup.effects[-3:], seed=0, settings=setup.settings)
    notes = {row.name: row.note for row in report.causes}
    assert "order_drift_of_thrust" in {e.name for e in setup.effects}
    assert all("three runs" in notes[n] for n in notes if n == "order_drift_of_thrust")


def test_what_was_described_after_the_fit_is_refused():
    """A law that the saved model does not know has no magnitudes of the fitted runs."""
    study = _fast_bench()
    frame = dict(setup_of(study).model.frame)
    plain = frame["scales"]["plain"]
    assert any(name.startswith("law ") for name in plain)
    other = {name.replace("law ", "law other_"): scale for name, scale in plain.items()}
    kept = {**frame["scales"], "plain": other}
    with pytest.raises(ValueError, match="is not in the saved model, which knows law other_"):
        setup_of(replace(study, frame={**frame, "scales": kept}))


def test_a_file_with_magnitudes_in_its_facts_is_refused(tmp_path):
    path = tmp_path / "extended_model.yaml"
    path.write_text("parameters: {}\neffects: {}\nfacts: {made_from: {laws: {}}}\n")
    with pytest.raises(ValueError, match="written by an earlier version"):
        read_extended(path)
