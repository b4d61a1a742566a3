"""What runs of each use decide: fitted, selecting, or looked at once after the answer is frozen."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from diffsim.data.study import TIMELESS, Study
from diffsim.diagnose import diagnose
from diffsim.diagnose import diagnosis as pipeline
from diffsim.diagnose.judge.gain import LeftOut, gain_over, validation_of
from diffsim.diagnose.judge.left_out import (
    Repeats,
    _refit_without,
    blocks_of,
    folds_of,
    left_out_residual,
)
from diffsim.diagnose.judge.own_values import held_out_residual
from diffsim.identify import DiagnosisSettings, SearchSettings, SimModel, fit
from diffsim.identify.effect import coordinate_of
from tests.diagnose import linear, toy

QUICK = DiagnosisSettings(search=SearchSettings(num_refits=2))
PUSH, OTHER = linear.line("push"), linear.line("other")


def recorded(name, seed, size, **changes):
    """A run with a push of known size."""
    run, model = linear.run(name, seed, **changes), linear.model()
    clean = model.predict(run, model.at_prior(), {PUSH: torch.tensor([size]).double()})
    return replace(run, measured=run.measured + clean.numpy())


def lines(*runs):
    return Study("lines", "copter", linear.CHANNELS, runs)


class Watched(SimModel):
    """A model that refuses to look at a test run before the answer is frozen."""

    def __init__(self):
        super().__init__(linear.model().build, linear.model().base, "watched")
        self.is_frozen, self.looked = False, []

    def predict(self, run, q, sizes=None, numerics=None):
        if run.use == "test":
            assert self.is_frozen, f"{run.name} was looked at before the answer was frozen"
            self.looked.append(run.name)
        return super().predict(run, q, sizes, numerics)


@pytest.mark.parametrize("use", ["fit", "select"])
def test_test_runs_are_looked_at_after_the_freeze_only(monkeypatch, use):
    runs = [recorded(f"r{k}", k, 1.0) for k in range(3)]
    study = lines(
        *runs, recorded("chosen_by", 5, 1.0, use=use), recorded("last", 6, 1.0, use="test")
    )
    model, freeze = Watched(), pipeline.report_of

    def frozen(*arguments):
        assert all(r.use != "test" for r in arguments[0].case.study.runs)
        report = freeze(*arguments)
        model.is_frozen = True
        return report

    monkeypatch.setattr(pipeline, "report_of", frozen)
    report = diagnose(study, model, (PUSH, OTHER), seed=0, settings=QUICK)
    assert report.named == ("push",) and set(model.looked) == {"last"}
    assert report.gain is not None and report.gain.value > 0.5


def test_what_test_runs_hold_changes_no_answer():
    """The same diagnosis with test runs of noise: equal to the last bit but for what is said of
    them."""
    study = toy.generate(2, {"drag": 0.2})
    held = study.test_runs[0]
    noise = np.random.default_rng(0).normal(size=held.measured.shape)
    noisy = replace(held, measured=noise)
    other = replace(study, runs=tuple(noisy if r is held else r for r in study.runs))
    effects = (toy.DRAG, toy.DELAY)
    one, two = (
        diagnose(s, toy.model(s.runs), effects, seed=0, settings=QUICK) for s in (study, other)
    )
    assert one.best.values == two.best.values
    assert one.hypotheses == two.hypotheses
    assert one.noise["sd"] == two.noise["sd"]
    assert one.errors != two.errors and one.gain != two.gain


def test_errors_on_test_runs_are_in_the_unit_of_the_recordings():
    runs = [recorded(f"r{k}", k, 1.0) for k in range(3)]
    study = lines(*runs, recorded("last", 6, 1.0, use="test"))
    study = replace(study, channels=tuple(replace(c, shown_unit="mm") for c in study.channels))
    report = diagnose(study, linear.model(), (PUSH, OTHER), seed=0, settings=QUICK)
    (row,) = report.errors
    assert (row.run, row.kind, row.unit, row.use, row.num_fitted) == (
        "last",
        "position",
        "mm",
        "test",
        0,
    )
    # channels of 0.5 and 2 m noise: their root mean square
    assert row.noise == pytest.approx(1e3 * np.sqrt((0.5**2 + 2.0**2) / 2), rel=1e-6)
    best = report.best
    left = (
        study.test_runs[0].measured
        - best.problem.predict(study.test_runs[0], torch.from_numpy(best.x)).numpy()
    )
    assert row.after == pytest.approx(1e3 * np.sqrt(np.mean(left**2)), rel=1e-9)
    assert row.before > row.after


def test_without_test_runs_no_gain_is_known():
    study = lines(*(recorded(f"r{k}", k, 1.0) for k in range(4)))
    report = diagnose(study, linear.model(), (PUSH, OTHER), seed=0, settings=QUICK)
    assert report.named == ("push",) and report.gain is None and report.errors == ()


def fit_rows(y, a):
    """Two base parameters and a heavy-tailed size, in scaled coordinates."""

    def cost(u):
        return np.concatenate([y - a @ u, u[:2], coordinate_of(u[2:])])

    return least_squares(cost, np.zeros(3), xtol=1e-12, ftol=1e-12, gtol=1e-12).x


def test_leaving_out_is_what_a_fit_to_the_rest_predicts():
    """Exact in a linear problem, whole runs and blocks of time alike."""
    runs = [recorded(f"r{k}", k, 1.0) for k in range(4)]
    one_command = [replace(r, group="same") for r in runs]
    for members, whole in ((runs, True), (one_command, False)):
        found = fit(linear.model(), members, linear.CHANNELS, effects=(PUSH,))
        folds = folds_of(found)
        assert folds is not None and all(f.is_whole == whole for f in folds.parts)
        assert np.sum([f.rows for f in folds.parts], axis=0).tolist() == [1] * len(found.residual)
        rows = left_out_residual(found, folds, Repeats(0))
        fold = folds.parts[1]
        kept = found.problem.whiten(runs[0], np.ones(runs[0].measured.size))
        assert len(kept) * len(runs) == len(found.residual)
        y, a = linear.matrices((PUSH,), members)
        keep = ~fold.rows
        rest = fit_rows(y[keep], a[keep])
        np.testing.assert_allclose(rows[fold.rows], y[fold.rows] - a[fold.rows] @ rest, atol=1e-4)


def test_fit_runs_left_out_refute_what_one_run_alone_asks_for():
    """A push that is opposite in one run of four: every part is worse off with the others' size."""
    for sizes, status in ((3.0, -1.0, -1.0, -1.0), "withdrawn"), ((1.0,) * 4, "confirmed"):
        runs = [recorded(f"r{k}", k, size) for k, size in enumerate(sizes)]
        fits = [
            fit(linear.model(), runs, linear.CHANNELS, effects=effects) for effects in ((), (PUSH,))
        ]
        validation = validation_of(fits[0], ())
        assert isinstance(validation, LeftOut)
        assert validation.words == "leaving out one command after the other among the fit runs"
        assert gain_over(validation, *fits, seed=0).status == status


def test_linear_refits_predict_as_full_ones_do_where_a_model_is_not_linear():
    study = toy.generate(3, {"drag": 0.2})
    found = fit(toy.model(study.runs), study.fit_runs, toy.CHANNELS, effects=(toy.DRAG,))
    folds = folds_of(found)
    assert folds is not None and len(folds.parts) == 3
    linear_only = left_out_residual(found, folds, Repeats(0))
    # each part against a fit without it, from the start
    for fold in folds.parts:
        kept = [r for i, r in enumerate(found.problem.runs) if i not in fold.runs]
        rest = fit(toy.model(study.runs), kept, toy.CHANNELS, effects=(toy.DRAG,))
        apart = [held_out_residual(rest, found.problem.runs[i]) for i in fold.runs]
        full = float(sum(r @ r for r in apart))
        near = float(linear_only[fold.rows] @ linear_only[fold.rows])
        assert near == pytest.approx(full, rel=0.02)


def test_a_repeated_fit_takes_no_more_than_its_share():
    """Of an arm of 34 numbers four of them took 90 of 185 million steps of a first answer."""
    study = toy.generate(3, {"drag": 0.2})
    found = fit(toy.model(study.runs), study.fit_runs, toy.CHANNELS, effects=(toy.DRAG,))
    fold, tally = folds_of(found).parts[0], found.problem.model.simulations
    far, taken, left = found.x + 1.0, [], []
    for steps in (0.0, np.inf):
        before = tally.steps
        left.append(float(np.sum(_refit_without(found, fold, far, steps) ** 2)))
        taken.append(tally.steps - before)
    assert taken[0] < 0.7 * taken[1] and left[0] > left[1]


def test_points_without_time_leave_blocks_of_a_film_as_they_are():
    """Clicked points are numbered, not dated: 60 "seconds" of them are no block."""
    film = linear.run("film", 1)
    clicks = replace(
        linear.run("clicks", 2),
        time_s=np.arange(float(linear.NUM_SAMPLES)),
        setup={TIMELESS: True},
    )
    folds = blocks_of(linear.problem(runs=(film, clicks)))
    assert folds is not None and len(folds.parts) >= 3
    assert all(fold.runs == (0,) for fold in folds.parts)
    dated = blocks_of(linear.problem(runs=(film, replace(clicks, setup={}))))
    assert dated is None or any(fold.runs != (0,) for fold in dated.parts)
