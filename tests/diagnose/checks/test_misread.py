"""A measured command that jumps: the sensor's mistake, or what acted? The model tells."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.command_jumps import jumps_of, without_jumps
from diffsim.data.study import Command
from diffsim.diagnose import diagnose
from diffsim.diagnose.checks.noise import choose_commands, without_misread
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.identify import DiagnosisSettings, SearchSettings
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import TIME, cart_study

SMOOTH = 10.0 * np.sin(2.0 * np.pi * (0.3 + 0.2 * TIME) * TIME)
LOAD_CELL = Command("force", "N", is_measured=True)
QUICK = DiagnosisSettings(search=SearchSettings(max_effects=1, num_refits=1))


def recorded(values, rows=(60, 61, 200), stays=140):
    """The force as a cell shows it that misreads three samples, and is 6 N off from one on."""
    off = values.copy()
    off[list(rows)] += 15.0
    off[stays:] += 6.0
    return off


def study_of(acting, shown, uses=("fit", "fit")):
    """Two carts pushed alike, of which the second's load cell shows something else."""
    found = cart_study(drive=lambda _: acting)
    runs = [
        replace(run, name=f"run{i}", group=f"run{i}", use=use, command={"force": force})
        for i, (run, use, force) in enumerate(
            zip(found.runs[:2], uses, (SMOOTH if acting is SMOOTH else acting, shown), strict=True)
        )
    ]
    return replace(found, runs=tuple(runs), commands=(LOAD_CELL,))


def fitted(study):
    model = setup_of(study).model
    return null_fit(Case(study, model, (), (), QUICK))


def test_without_jumps_it_is_what_it_was():
    shown = recorded(SMOOTH)
    jumps = jumps_of(shown, is_measured=True)
    assert (jumps.back, jumps.lasting) == ([60, 61, 200], [140])
    mended = without_jumps(shown, TIME, jumps)
    assert np.abs(mended - SMOOTH).max() < 0.05 < np.abs(shown - SMOOTH).max()
    # samples that nobody recorded stay unknown, and are no jump
    shown[20] = np.nan
    again = without_jumps(shown, TIME, jumps_of(shown, is_measured=True))
    assert np.isnan(again[20]) and np.nanmax(np.abs(again - SMOOTH)) < 0.05


def test_what_is_commanded_and_what_does_not_jump_stays_as_it_is():
    study = study_of(SMOOTH, recorded(SMOOTH))
    asked = replace(LOAD_CELL, is_measured=False)
    assert without_misread(study.runs[1], (asked,)) == (study.runs[1], 0)
    assert without_misread(study.runs[0], (LOAD_CELL,)) == (study.runs[0], 0)
    run, count = without_misread(study.runs[1], (LOAD_CELL,))
    assert count == 4 and np.abs(run.command["force"] - SMOOTH).max() < 0.05


def test_a_model_that_does_not_use_the_command_takes_it_without_jumps():
    run = study_of(SMOOTH, recorded(SMOOTH)).runs[1]
    found, count = choose_commands(run, (LOAD_CELL,), lambda r: r.measured, np.ones(1))
    assert count == 4 and found is not run


def test_a_fit_is_that_of_the_force_which_acted():
    null = fitted(study_of(SMOOTH, recorded(SMOOTH)))
    assert (null.num_misread, null.fit.chi2 / null.fit.num_samples) == (
        4,
        pytest.approx(1.0, abs=0.15),
    )


def test_a_jump_that_acted_is_kept():
    acting = recorded(SMOOTH)
    null = fitted(study_of(acting, acting))
    assert null.num_misread == 0
    assert null.fit.chi2 / null.fit.num_samples == pytest.approx(1.0, abs=0.15)
    assert all(np.array_equal(r.command["force"], acting) for r in null.case.study.runs)


def test_a_run_that_nobody_has_seen_is_judged_without_its_jumps():
    study = study_of(SMOOTH, recorded(SMOOTH), uses=("fit", "test"))
    model = setup_of(study).model
    report = diagnose(study, model, (), seed=0, settings=QUICK)
    row = next(r for r in report.errors if r.run == "run1")
    assert row.after == pytest.approx(1e-3, rel=0.2)
