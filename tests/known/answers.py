"""Populations of the diagnosis: searches, what checks find, whole answers, what pages show."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.tables import FIRST_LOOK
from diffsim.identify import DiagnosisSettings, SearchSettings, UnknownDrift
from diffsim.systems.registry import setup_of
from diffsim.viz.diagnosis_report import write_diagnosis
from tests.known.fingerprint import numbers_in
from tests.known.pages import parts_of_page
from tests.known.studies import STUDIES
from tests.studies import NAMES, study_of

SHORT = SearchSettings(max_effects=1, num_refits=1, max_rounds=1)


def facts_of(found: Report) -> dict[str, Any]:
    """All of an answer that is a number or a word of its own."""
    said = [found.headline, *found.sentences, *found.cannot_see.values()]
    return {
        "named": [found.verdict, found.named, found.causes, found.rivals, found.hypotheses],
        "table": [found.table, found.errors, found.base, found.outside, found.own],
        "gates": [(g.name, g.value, g.limit, g.passed) for g in found.gates],
        "said": [len(said), *map(numbers_in, said)],
        "laws": found.described,
        "gain": [found.gain, found.unknown_share, found.interval_factor, found.band, found.bands],
    }


def facts_of_search(search: Any) -> dict[str, Any]:
    """What a search weighed, fitted and left."""
    nats = {str(sorted(key.effects)): search.nats(key) for key in search.posteriors}
    return {
        "nats": nats,
        "fits": {str(sorted(k)): [f.x, f.chi2, f.prior] for k, f in search.fits.items()},
        "left": [search.num_late, len(search.failed), search.best_cost(), len(search.linear)],
    }


def searches(folder: Path) -> dict[str, Any]:
    """Causes with kinks: alone, signed, in pairs, beside what nobody knows, within budgets."""
    from tests.diagnose import linear
    from tests.diagnose.search import test_scan as case

    pair, push = case.Pair(), linear.line("push")
    both = {pair.slack: 6.0, pair.rate_limit: 2.0}
    narrow = replace(case.clipped(), tries=(0.7, 3.0, 8.0))
    short = DiagnosisSettings(search=replace(DiagnosisSettings().search, scan_points=12))
    drift = (UnknownDrift(0, "drift"),)
    asked: dict[str, tuple[Any, ...]] = {
        "limit": ((push, case.clipped()), {case.clipped(): 4.0}),
        "signed": ((push, case.clipped(signed=True)), {case.clipped(signed=True): -3.0}),
        "tried": ((push, narrow), {narrow: 4.0}),
        "pair": ((push, pair.slack, pair.rate_limit), both),
        "few": ((pair.slack, pair.rate_limit, push), both, short),
        "drift": ((push, case.clipped()), {push: 3.0}, None, drift),
    }
    return {
        f"{name} {part}": value
        for name, given in asked.items()
        for part, value in facts_of_search(case.searched(*given)).items()
    }


def coarse_searches(folder: Path) -> dict[str, Any]:
    """First answers by coarse simulations, corrected; searches that begin where others ended."""
    from diffsim.diagnose.search.coarse import renewed_at
    from diffsim.diagnose.search.search import begin_from, search_sets
    from tests.diagnose.checks import test_refine as refined
    from tests.diagnose.search import test_begin_from as begun
    from tests.diagnose.search import test_coarse as case

    _, null, found = case.correct_toy()
    problem = null.wide
    x = np.append(null.fit.x, [0.2, 0.1])
    coarse = search_sets(begun.start(begun.plain()))
    best = frozenset({0, 1})
    again = search_sets(begin_from(begun.finer(1.0), best, coarse.fit_of(best).x))
    checked = refined.check_numerics(refined.null_fit(refined.case()))
    return {
        "gates": [(g.name, g.value, g.limit, g.passed) for g in [*found.gates, *checked.gates]],
        "finest": [vars(found.correction.finest), checked.changes],
        "record": [problem.record(x), renewed_at(null.fit)[1]],
        **{f"coarse {k}": v for k, v in facts_of_search(coarse).items()},
        **{f"begun {k}": v for k, v in facts_of_search(again).items()},
    }


def toy_answers(folder: Path) -> dict[str, Any]:
    """Whole answers about the toy: causes alone and together, dear simulations, coarse meshes."""
    from tests.diagnose import toy
    from tests.diagnose.checks import test_refine as refined
    from tests.diagnose.search import test_coarse as case

    library = (toy.BIAS, toy.DELAY, toy.STIFFENING, toy.DRAG)
    asked = {
        "bias": ({"bias": 0.3}, library, case.DEAR),
        "both": ({"bias": 0.3, "delay": 0.03}, library, DiagnosisSettings()),
    }
    found = {}
    for name, (hidden, effects, settings) in asked.items():
        study = case.noisy(hidden)
        model = toy.model(study.runs, case.STEP)
        found[name] = diagnose(study, model, effects, seed=0, settings=settings)
    found["mesh"] = refined.diagnosed_kink(budget=1.0)
    return {f"{n} {part}": v for n, r in found.items() for part, v in facts_of(r).items()}


def answered(study: Study, folder: Path) -> dict[str, Any]:
    """What a short search says of a study, laws looked for, and its page."""
    made = setup_of(study)
    settings, told = replace(made.settings or DiagnosisSettings(), search=SHORT), {}
    report = diagnose(
        made.study or study,
        made.model,
        made.effects,
        seed=0,
        unknowns=made.unknowns,
        settings=settings,
        progress=lambda stage, _, message: told.update({stage: numbers_in(message)}),
        laws=made.laws,
    )
    page = write_diagnosis(report, folder / "report.html").read_text("utf-8")
    looked = {"first look": told.get(FIRST_LOOK, [])}
    return {**facts_of(report), **looked, **{f"page {k}": v for k, v in parts_of_page(page)}}


def whole(*names: str) -> Callable[[Path], Mapping[str, Any]]:
    """Whole answers about small studies, by their names."""

    def make(folder: Path) -> dict[str, Any]:
        studies = {n: study_of(n) if n in NAMES else STUDIES[n](folder) for n in names}
        return {
            f"{name} {part}": value
            for name, study in studies.items()
            for part, value in answered(study, folder).items()
        }

    return make


def described(law: str) -> Callable[[Path], Mapping[str, Any]]:
    """A whole answer about a table on which a law acts that nobody listed, by its name."""

    def make(folder: Path) -> dict[str, Any]:
        from tests.diagnose.discover import test_stage as case
        from tests.diagnose.discover.turntable import turntable_study

        uses = ("fit", "fit", "select", "test")
        push = getattr(case, law)
        return answered(turntable_study(push, uses=uses, noise=case.NOISE, count=120), folder)

    return make


def faulty_stages(folder: Path) -> dict[str, Any]:
    """Verdicts on stages of two axes: sound, off, stuck, both at once, misread."""
    from diffsim.data import load_study
    from diffsim.diagnose.faults import judge_faults
    from tests.diagnose.faults import test_goals as case

    random = np.random.default_rng(case.SEED)
    for n in range(6):
        case.write(folder / f"known{n}.csv", random, "missed" if n == 5 else "")
    for change in ("sound", "off", "stuck", "misread"):
        case.write(folder / f"{change}_0.csv", random, change)
    both = np.loadtxt(folder / "stuck_0.csv", delimiter=",", skiprows=1)
    both[:, 1] += 25.0
    head = "time_s,x1,x2,goal_1,goal_2"
    np.savetxt(folder / "both_0.csv", both, delimiter=",", header=head, comments="")
    text = case.STUDY.replace('"{n}.csv"', '"{n}_{k}.csv"')
    (folder / "study.yaml").write_text(text, "utf-8")
    study = load_study(folder)
    found = judge_faults(study, setup_of(study))
    out: dict[str, Any] = {"spreads": found.spreads}
    for v in found.verdicts:
        lead = [v.lead_by_runs, v.lead_by_labels, v.rivals, v.strength, v.smallest_visible]
        out[v.group] = [v.status, v.causes, v.sound, v.sizes, v.sets, lead]
    return out


ANSWERS: Mapping[str, Callable[[Path], Mapping[str, Any]]] = {
    "searches": searches,
    "coarse searches": coarse_searches,
    "toys": toy_answers,
    "benches": whole("bench", "tared", "seals"),
    "faults": faulty_stages,
    "flows": whole("flow_in_time"),
    "laws of an angle": described("cogging"),
    "laws of a temperature": described("thinner_when_warm"),
    "others": whole("arm", "outside"),
    "rigs": whole("joints", "junction", "ode_stores", "wind"),
}
