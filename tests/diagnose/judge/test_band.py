"""The band for unseen runs: its coverage where the model is wrong, and what it is made from."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import diagnose_band
from diffsim.diagnose import diagnose
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge import band as judged
from diffsim.diagnose.judge.band import (
    Band,
    BandVariance,
    Part,
    _changes,
    _principal_moves,
    band_from,
    band_of,
    factor_of,
    noise_of,
    settled,
    unfitted_parts,
    variances_of,
)
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.diagnose.judge.records import LEVEL, ErrorRow, band_words
from diffsim.diagnose.judge.unseen import outside_rows, spans_of, times_outside
from diffsim.identify import DiagnosisSetup, Fit, WhiteNoise, fit
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.model_file import read_extended
from tests.diagnose import linear, toy

SD = np.array([c.sd for c in linear.CHANNELS])
QUICK = DiagnosisSettings(search=SearchSettings(num_refits=2))


def with_error(name, rng, scatter=0.5):
    """A run of the linear model, and beside it shapes that no model has, of its own strength."""
    made = linear.run(name, int(rng.integers(2**31)))
    strength = 2.0 * np.exp(scatter * rng.normal())
    time = made.time_s / made.time_s[-1]
    unknown = np.stack([np.sin(3.0 * time), np.cos(2.0 * time)], axis=1) * SD
    known = linear.shapes("mass", made).numpy()[..., 0] * 0.5
    return replace(made, measured=made.measured + known + strength * unknown)


def fitted(runs) -> Fit:
    return fit(linear.model(), runs, linear.CHANNELS, whitener=WhiteNoise(linear.CHANNELS))


def posterior_sd(fit: Fit):
    return np.sqrt(np.diag(fit.covariance))


def widths(band: Band, found: Fit, run, times=1.0):
    return band.half_widths(
        found, posterior_sd(found), run, times, channels=linear.CHANNELS, unmet=()
    )


def share_inside(found: Fit, half, run) -> float:
    said = found.problem.predict(run, torch.from_numpy(found.x)).numpy()
    return float(np.mean(np.abs(run.measured - said) <= half))


@pytest.mark.reference
@pytest.mark.parametrize("count", [4, pytest.param(8, marks=pytest.mark.story)])
def test_coverage_where_the_model_is_wrong(count):
    rng = np.random.default_rng(count)
    shares, by_noise = [], []
    for draw in range(240 // count):  # as many parts in all
        *seen, unseen = (with_error(f"r{draw}_{k}", rng) for k in range(count + 1))
        found = fitted(seen)
        band = band_of(found, linear.CHANNELS, SD, ())
        assert band.num_parts == count
        shares.append(share_inside(found, widths(band, found, unseen), unseen))
        by_noise.append(share_inside(found, 1.645 * SD, unseen))
    assert 0.85 <= np.mean(shares) <= 0.95
    assert np.mean(by_noise) < 0.7  # what the noise alone would promise


def test_select_runs_tell_the_band_too():
    rng = np.random.default_rng(3)
    seen = [with_error(f"s{k}", rng) for k in range(3)]
    found = fitted(seen)
    far = replace(with_error("far", rng), use="select")
    far = replace(far, measured=far.measured + 40.0 * SD)
    alone, both = (band_of(found, linear.CHANNELS, SD, select) for select in ((), (far,)))
    assert (alone.num_parts, both.num_parts) == (3, 4)
    assert widths(both, found, far).min() > 2.0 * widths(alone, found, far).max()


@pytest.mark.reference
def test_half_of_the_width_is_the_root_of_a_sum_of_variances():
    rng = np.random.default_rng(5)
    found = fitted([with_error(f"w{k}", rng) for k in range(3)])
    band = band_of(found, linear.CHANNELS, SD, ())
    new = linear.run("new", 8)
    slopes = np.stack([linear.shapes(n, new).numpy()[..., 0] for n in ("mass", "gain")], -1)
    slopes = slopes * [0.7, 1.5]  # by standardized coordinates
    spread = np.einsum("tci,ij,tcj->tc", slopes, found.covariance, slopes)
    rest = np.array([band.rest[c.name] for c in linear.CHANNELS])
    for times, grown in ((1.0, 1.0), (2.0, 4.0)):
        beyond = rest**2 + band.excess**2 * spread
        expected = band.factor * np.sqrt(SD**2 + spread + grown**2 * beyond)
        np.testing.assert_allclose(widths(band, found, new, times), expected, rtol=1e-8)


def part(*left, spread=0.0, times=1.0) -> Part:
    return Part(np.array(left)[:, None], np.full((len(left), 1), spread), times)


ONE = np.ones(1)
STEPS = tuple(np.linspace(0.0, 3.0, 101))


def test_parts_that_are_alike_need_no_wider_band():
    for count in (2, 8):
        told, factor = factor_of([part(*STEPS)] * count, ONE)
        assert factor * np.sqrt(1.0 + told.rest[0]) == pytest.approx(2.7, rel=0.02)


def test_parts_that_differ_make_a_wide_band():
    """Each is told by the others: the loud one by the calm ones."""
    calm, loud = part(*STEPS), part(*(3.0 * s for s in STEPS))
    (told, factor), (_, alike) = (factor_of(p, ONE) for p in ([calm, calm, loud], [calm] * 3))
    others = np.sqrt(np.mean(np.square(STEPS)))
    assert factor > 1.3 * alike
    assert np.mean(3.0 * np.array(STEPS) <= factor * others) > 0.7
    assert told.rest[0] == pytest.approx(11.0 / 3.0 * others**2 - 1.0)


@pytest.mark.parametrize(("scatter", "most"), [(0.5, 0.14), (0.0, 0.03)])
def test_few_parts_that_differ_hold_one_more(scatter, most):
    """One more than three had under 80 % inside in 17 of these 100 draws where sizes differ, now in
    11; parts that are alike hold as many as before."""
    rng, inside = np.random.default_rng(4), []
    for _ in range(100):
        sizes = 10.0 * np.exp(scatter * rng.standard_normal(4))
        counts = (30, 30, 30, 1000)
        *parts, new = (
            part(*(size * rng.standard_normal(n))) for size, n in zip(sizes, counts, strict=True)
        )
        told, factor = factor_of(parts, ONE)
        inside.append(np.mean(np.abs(new.left) <= factor * np.sqrt(1.0 + told.rest[0])))
    assert np.mean(np.array(inside) < 0.8) <= most
    assert 0.87 < np.mean(inside) < 0.95


def test_every_part_weighs_the_same():
    calm, wild = part(*([0.1] * 1000)), part(*([3.0] * 10))
    told, factor = factor_of([calm, wild, calm, wild], ONE)
    assert factor * np.sqrt(1.0 + told.rest[0]) > 3.0


def test_what_the_posterior_says_of_a_part_is_no_rest():
    told, factor = factor_of([part(4.0, -4.0, spread=15.0)] * 2, ONE)
    # noise and posterior explain all 16 of it; the rounds end a hundredth before zero
    assert told.rest[0] + 15.0 * told.excess < 0.2 and factor == pytest.approx(1.0, rel=0.01)


def test_known_parts_tell_the_rest_and_hardly_known_ones_the_excess():
    """What alone tells of a parameter is far off without it: runs that the fit knows are not."""
    known = [part(3.0, -3.0, spread=1e-4)] * 4
    alone = [part(90.0, -90.0, spread=100.0)] * 4
    told, factor = factor_of([*known, *alone], ONE)
    assert told.rest[0] == pytest.approx(8.0, rel=0.05)
    assert told.excess == pytest.approx(80.0, rel=0.05)
    assert factor < 1.3


def test_the_variances_are_the_most_likely_ones():
    """Each at the other; for the rest a part counts as much as it is known."""
    parts = [part(2.0, spread=1.0), part(9.0, spread=4.0, times=1.5), part(1.5, spread=0.1)]
    known = np.array([1.0 / (1.0 + p.spread[0, 0]) for p in parts])

    def likelihood(rest, excess, weight):
        told = BandVariance(np.array([rest]), excess)
        v = np.array([told.variance(ONE, p)[0, 0] for p in parts])
        return np.sum(weight * (-np.log(v) - np.array([p.left[0, 0] ** 2 for p in parts]) / v))

    told = variances_of(parts, ONE)
    rest, excess = told.rest[0], told.excess
    assert rest > 0.1 and excess > 0.1
    for more in (-0.02, 0.02):
        best = likelihood(rest, excess, known), likelihood(rest, excess, 1.0)
        assert likelihood(rest + more, excess, known) < best[0]
        assert likelihood(rest, excess + more, 1.0) < best[1]


def test_a_hardly_known_part_says_little_of_the_rest():
    """An arm without its 300 mbar: seven times outside, and told by its posterior alone."""
    known = [part(0.1, -0.1, spread=1e-4), part(0.15, -0.15, spread=1e-4)]
    far = part(1.0, -1.0, spread=1.0, times=7.0)
    noise = np.array([0.05])
    alone, told = variances_of(known, noise), variances_of([*known, far], noise)
    assert told.rest[0] > 0.3 * alone.rest[0]


def test_a_misfit_below_a_noise_stated_too_large_is_no_noise():
    """Readings that differ by 0.1 from each other and lie 2 off, under a noise of 10."""
    left = 2.0 + 0.1 * np.random.default_rng(4).normal(size=400)
    (noise,) = noise_of([part(*left)] * 3, np.array([10.0]))
    assert noise == pytest.approx(0.1, rel=0.1)
    assert noise_of([part(*left)] * 3, ONE) == ONE


def test_one_part_tells_no_band(monkeypatch):
    found = fitted([with_error("only", np.random.default_rng(9))])
    for count, is_told in ((1, False), (2, True)):
        few = unfitted_parts(found, linear.CHANNELS, ())[:count]
        monkeypatch.setattr(judged, "unfitted_parts", lambda *_, few=few: few)
        assert (band_of(found, linear.CHANNELS, SD, ()) is not None) == is_told


def test_the_spread_of_a_part_is_that_of_the_fit_without_it():
    rng = np.random.default_rng(11)
    runs = [with_error(f"p{k}", rng) for k in range(4)]
    parts = unfitted_parts(fitted(runs), linear.CHANNELS, ())
    for k, found in enumerate(parts):
        rest = fitted([run for i, run in enumerate(runs) if i != k])
        slopes = np.stack([linear.shapes(n, runs[k]).numpy()[..., 0] for n in ("mass", "gain")], -1)
        slopes = slopes * [0.7, 1.5]  # by standardized coordinates
        spread = np.einsum("tci,ij,tcj->tc", slopes, rest.covariance, slopes)
        np.testing.assert_allclose(found.spread, spread, rtol=1e-6)


class Growth:
    """Readings that grow as exp(a + b)."""

    bounds = np.full(2, -np.inf), np.full(2, np.inf)

    def scaled(self, x):
        return x

    standardized = scaled

    def stretch(self, x):
        return np.ones(2)

    def predict_many(self, run, points):
        return torch.stack([torch.exp(p.sum()).reshape(1, 1) for p in points])


def test_correlated_parameters_move_together():
    """Each alone would move the reading twenty-fold; together they may move it by a seventh."""
    correlation = np.array([[1.0, -0.999], [-0.999, 1.0]])
    root = _principal_moves(correlation)
    np.testing.assert_allclose(root @ root.T, correlation, atol=1e-12)
    at = type("At", (), {"problem": Growth()})()
    (changes,) = _changes(at, np.zeros(2), 3.0 * root.T, None)
    assert np.sqrt(np.sum(changes**2)) == pytest.approx(3.0 * np.sqrt(0.002), rel=0.1)


@pytest.mark.parametrize(("room", "share"), [(0.0, -1.0), (0.04, -1.0), (0.06, 0.6), (9.0, 1.0)])
def test_moves_stay_within_bounds_and_are_told_as_whole_ones(room, share):
    at = type("At", (), {"problem": Growth()})()
    at.problem.bounds = np.full(2, -np.inf), np.array([room, np.inf])
    (changes,) = _changes(at, np.zeros(2), np.eye(2) * 0.1, None)
    assert changes == pytest.approx([(np.exp(0.1 * share) - 1.0) / share, np.exp(0.1) - 1.0])


def test_of_a_channel_that_no_part_measured_nothing_is_said():
    rng = np.random.default_rng(6)
    blind = np.array([0.0, np.nan])
    runs = [with_error(f"b{k}", rng) for k in range(4)]
    runs = [replace(r, measured=r.measured + blind) for r in runs]
    found = fitted(runs)
    band = band_of(found, linear.CHANNELS, SD, ())
    half = widths(band, found, linear.run("new", 8))
    assert np.isfinite(half[:, 0]).all() and np.isnan(half[:, 1]).all()


def test_a_saved_model_states_the_same_band_as_its_report(tmp_path):
    study = toy.generate(2, {"drag": 0.2})
    model = toy.model(study.runs)
    report = diagnose(study, model, (toy.DRAG,), seed=0, settings=QUICK)
    report.save(tmp_path)
    saved = read_extended(tmp_path)
    setup = DiagnosisSetup(model=model, effects=(toy.DRAG,))
    found = judge_saved(Inputs(study, setup, 0, {}), saved)
    told = {(row.run, row.kind): row for row in found.errors}
    assert report.errors and report.bands.keys() == found.bands.keys()
    for row in report.errors:
        same = told[row.run, row.kind]
        assert row.band == pytest.approx(same.band, rel=1e-3)
        assert row.num_inside == same.num_inside
        assert row.band > 1.645 * row.noise * 0.9
    for name, half in report.bands.items():
        np.testing.assert_allclose(half, found.bands[name], rtol=5e-3)
    said = band_words(found.errors)
    assert said in report.sentences and said.startswith("The 90 % band holds ")
    again = band_from(saved.facts["band"])
    np.testing.assert_allclose(again.correlation, report.band.correlation, atol=1e-5)


def test_runs_that_chose_prove_no_band():
    row = ErrorRow("a", "position", "m", 2.0, 1.0, 1.0, 100, 0, "test", 1.7, 91)
    assert band_words([row]) == "The 90 % band holds 91 % of 100 readings of unseen runs."
    assert not band_words([replace(row, use="select")])
    assert not band_words([replace(row, band=None)])


def test_the_docs_say_what_the_band_is_made_from():
    """The formula of the module, its level and its condition on parts."""
    docs = Path(judged.__file__).parents[3] / "docs"
    method = (docs / "diagnosis_method.md").read_text(encoding="utf-8")
    formula = re.search(r"factor \* sqrt\((.*?)\)", judged.__doc__).group(1)
    assert f"f √({formula.replace('^2', '²')})" in method
    assert f"The factor f is the {100 * LEVEL:.0f} % quantile" in method
    assert "Student" not in method.split("The **band**")[1].split("####")[0]
    user = (docs / "diagnose.md").read_text(encoding="utf-8")
    row = ErrorRow("a", "position", "m", 2.0, 1.0, 1.0, 200, 0, "test", 1.7, 180)
    assert re.sub(r"\d+", "#", band_words([row])) in re.sub(r"\d+", "#", user)


def test_the_docs_hold_the_table_that_the_benchmark_prints():
    path = Path(judged.__file__).parents[3] / "docs/measured/coverage.md"
    part = path.read_text(encoding="utf-8").split("## The band for unseen runs")[1].split("##")[0]
    rows = [line.split(" | ") for line in part.splitlines() if line.startswith("| ")]
    assert " | ".join(rows[0]) == diagnose_band.HEAD
    named = {row[0].strip("| ") for row in rows[1:-1]}
    left_out = {name for name in diagnose_band.NAMES if f"`{name}`" in part}
    assert named | left_out == set(diagnose_band.NAMES) and not named & left_out
    # what nothing was fitted to is held as promised
    means = [float(cell.strip(" |%")) / 100.0 for cell in rows[-1][2:]]
    assert all(0.85 <= mean <= 0.95 for mean in means)


def test_the_band_widens_with_the_distance_from_what_was_fitted():
    """A model that lacks a square: commands of 1 to 1.4 are fitted, one of 3 is not."""

    def commanded(name, level):
        made = linear.run(name, 3)
        lacks = 3.0 * (level - 0.9) ** 2 * SD
        command = {"u": np.full(len(made.time_s), level)}
        return replace(made, measured=made.measured + lacks, command=command)

    found = fitted([commanded(f"u{level}", level) for level in (1.0, 1.1, 1.2, 1.3, 1.4)])
    band = band_of(found, linear.CHANNELS, SD, ())
    far, near = commanded("far", 3.0), commanded("near", 1.2)
    spans = spans_of(found.problem.runs, linear.CHANNELS)
    times = times_outside(outside_rows([far], linear.CHANNELS, spans))
    assert times == pytest.approx((3.0 - 1.2) / 0.2, rel=0.01)
    assert share_inside(found, widths(band, found, near), near) >= 0.8
    assert share_inside(found, widths(band, found, far), far) == 0.0
    assert share_inside(found, widths(band, found, far, times), far) >= 0.8


def test_a_part_whose_fit_ran_away_tells_no_band():
    calm, mad = part(*STEPS), replace(part(1e3, 2e3), ran_away=True)
    assert settled([calm, calm, mad]) == [calm, calm]
    assert mad in settled([calm, mad])  # too few are left to tell


def test_noise_that_is_stated_too_large_does_not_hide_the_rest():
    rng = np.random.default_rng(2)
    runs = [with_error(f"n{k}", rng) for k in range(4)]
    found = fitted(runs)
    honest, stated = (band_of(found, linear.CHANNELS, sd, ()) for sd in (SD, 20.0 * SD))
    assert honest.noise == {c.name: c.sd for c in linear.CHANNELS}
    assert all(stated.noise[c.name] < 5.0 * c.sd for c in linear.CHANNELS)
    assert max(stated.rest.values()) > 0.0
    near, far = (widths(stated, found, runs[0], times).mean() for times in (1.0, 3.0))
    assert far > 2.0 * near
