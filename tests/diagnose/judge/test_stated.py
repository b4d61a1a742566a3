"""What is saved and judged is what is named: sizes as stated, and the gain that these have."""

from dataclasses import replace

import pytest

from diffsim.diagnose import diagnose
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.averaging import averaged
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.diagnose.judge.records import HALF_LEVEL
from diffsim.diagnose.say import assemble
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.diagnose.search.simulations import NONE
from diffsim.identify.model_file import read_extended
from tests.diagnose import toy, toy_setup


@pytest.fixture(scope="module")
def disagreeing():
    """Drag, and a spring that breathes: beside an unknown force drag is a fifth larger.

    Returns:
        Study, setup, report, what sizes were averaged from.
    """
    study = toy.generate(31, {"drag": 0.2, "tide": 0.05})
    setup, made = toy_setup.setup(study), []

    def watched(*args):
        made.append(averaged(*args))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assemble, "averaged", watched)
        report = diagnose(
            study,
            setup.model,
            setup.effects,
            seed=0,
            unknowns=setup.unknowns,
            settings=setup.settings,
        )
    return study, setup, report, made[-1]


def test_sets_that_disagree_are_saved_as_they_are_stated(disagreeing, tmp_path):
    """Of an arm a size was stated as 1.48 to 1.83, and 1.98 was saved and judged."""
    study, setup, report, about = disagreeing
    saved = read_extended(report.save(tmp_path))
    assert report.verdict == "named" and report.named == ("drag",)
    for name in saved.components:
        row = next(row for row in report.causes if row.name == name)
        size = row.size["size"]
        assert size.value == pytest.approx(saved.values[name], rel=1e-9)
        assert size.low < size.value < size.high
        table = next(row for row in report.table if row.effect == name)
        assert table.size["size"] == pytest.approx(size.value, rel=1e-9)
    for row in report.base:
        assert row.value == pytest.approx(saved.values[row.name], rel=1e-9)
        assert row.low <= row.value <= row.high
    # the sets do disagree: the mean over all of them is not what is saved, and inside as well
    i = next(i for i, e in enumerate(setup.effects) if e.name == "drag")
    mean = replace(about, members=NONE).size(i)["size"]
    drag = next(row for row in report.causes if row.name == "drag").size["size"]
    assert abs(mean.value / drag.value - 1.0) > 0.1 and not mean.low < drag.value < mean.high
    assert drag.low <= mean.low and mean.high <= drag.high
    judged = judge_saved(Inputs(study, setup, 0, {}), saved, [r.name for r in study.test_runs])
    assert judged.gain.value == pytest.approx(report.gain.value, abs=1e-3)
    for before, after in zip(report.errors, judged.errors, strict=True):
        assert (after.before, after.after) == pytest.approx((before.before, before.after), rel=1e-3)


def test_the_file_holds_the_intervals_that_are_stated(disagreeing, tmp_path):
    """Those of the fit alone are too narrow where sets of causes, or parts of runs, disagree."""
    _, _, report, _ = disagreeing
    saved = read_extended(report.save(tmp_path))
    stated = {row.name: row.size["size"] for row in report.causes if row.name in saved.components}
    stated |= {row.name: row for row in report.base}
    assert set(saved.ranges) == set(stated)
    for name, known in saved.ranges.items():
        assert (known.low, known.high) == (stated[name].low, stated[name].high)
    drag = saved.ranges["drag"]
    assert drag.high - drag.low > 2.0 * 2.0 * HALF_LEVEL * saved.sd["drag"]


def test_a_cause_that_is_not_saved_is_a_mean_over_the_sets_that_hold_it(disagreeing):
    _, setup, report, about = disagreeing
    held = {effect.name for effect in report.best.problem.effects}
    for i, effect in enumerate(setup.effects):
        if effect.name not in held:
            assert about.size(i) == replace(about, members=NONE).size(i)
    assert about.members


def test_beside_what_may_be_zero_a_size_holds_that_of_the_set_without_it(disagreeing):
    """Of a starfish one answer said 6.5 to 8.2 mm of slack; 8.5 to 9.8 beside a law of -900 to
    3600."""
    _, setup, _, about = disagreeing
    wide, found = about.search.wide, about.search.fits
    i = next(i for i, e in enumerate(setup.effects) if e.name == "drag")
    pairs = (m for m in found if len(m) == 2 and i in m)
    pair = next(m for m in pairs if all(wide.effects[j].signed for j in m - {i}))
    (k,), without = pair - {i}, Hypothesis(frozenset({i}))
    names = [wide.names[wide.columns_of(e)[0]] for e in wide.effects]
    # the other cause takes up much of the drag
    apart = about.search.posteriors[without]
    moved = apart.fit.x.copy()
    moved[apart.fit.problem.names.index(names[i])] += 0.2
    apart = replace(apart, fit=replace(apart.fit, x=moved))
    search = replace(about.search, posteriors={**about.search.posteriors, without: apart})
    single = replace(about, search=search, members=without.effects, sized={without: 1.0})
    alone = single.size(i)["size"].value

    def drag(factor):
        sized, factors = {Hypothesis(pair): 1.0}, {names[i]: 1e-9, names[k]: factor}
        known = replace(about, search=search, members=pair, sized=sized, factors=factors)
        assert not known.may_be_zero(i) and known.may_be_zero(k) == (factor > 1.0)
        return known.size(i)["size"]

    sure, open_ = drag(1e-9), drag(1e9)
    assert not sure.low < alone < sure.high
    assert open_.low < alone < open_.high and open_.value == sure.value
    assert open_.low <= sure.low and sure.high <= open_.high


def test_a_fit_that_ended_before_its_optimum_is_uncertain_by_what_is_left_of_the_way(disagreeing):
    """Of an arm 17.5 to 18.9 N m of friction was stated by a fit on its way to 19.0."""
    _, setup, _, about = disagreeing
    i = next(i for i, e in enumerate(setup.effects) if e.name == "drag")
    alone = Hypothesis(frozenset({i}))
    entry = about.search.posteriors[alone]
    begun = entry.fit.x.copy()
    begun[-1] -= 6.0 * entry.fit.covariance[-1, -1] ** 0.5

    def size(ended):
        there = replace(entry, fit=replace(entry.fit, x=begun, ended=ended))
        search = replace(about.search, posteriors={**about.search.posteriors, alone: there})
        of = replace(about, search=search, sized={alone: 1.0}, members=NONE, factors={}, usual=1.0)
        return of.size(i)["size"]

    optimum = float(entry.fit.values["drag"])
    assert size("converged").high < optimum
    assert size("budget").low < size("converged").low and size("budget").high > optimum
