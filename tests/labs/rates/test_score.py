"""What an answer counts as, by hand; and what is counted over rows."""

import csv
import io

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from labs.rates.case import farthest_kept
from labs.rates.page import write_page
from labs.rates.score import held_sizes, outcome, scored
from labs.rates.sheets import held_sheets
from labs.rates.table import (
    Rate,
    band_lines,
    csv_text,
    outcome_table,
    rates,
    reliability,
    wrong_lines,
)


def row(kind, verdict, named=(), rivals=(), certain=(), *, hidden="drag", also=(), **more):
    """A row with its answer; every name that is not certain is likely."""
    names = {n for s in (named, *rivals) for n in s}
    truth = {} if kind == "null" else {hidden: [0.1]}
    return {
        "domain": "toy",
        "index": 4,
        "rig": "cart",
        "kind": kind,
        "hidden": "" if kind == "null" else hidden,
        "size": [0.1],
        "truth": {"sizes": truth, "also": list(also)},
        "lambda": 12.0,
        "trouble": "",
        "denies": "row" if kind == "denied" else "",
        "verdict": verdict,
        "named": list(named),
        "rivals": [list(r) for r in rivals],
        "statuses": {n: "certain" if n in certain else "likely" for n in {*names, *certain}},
        "stated": {n: ["effect", 0.995 if n in certain else 0.85] for n in names},
        "intervals": {n: {"size": [0.11, 0.09, 0.12]} for n in names},
        "simulations": 10,
        "cpu_s": 2.0,
        **more,
    }


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (row("null", "none"), "right"),
        (row("null", "unknown"), "false alarm"),
        (row("null", "named", ["lag"], certain=["lag"]), "false alarm"),
        (row("null", "ambiguous", ["lag"], [[]]), "ambiguous"),
        (row("null", "ambiguous", ["lag"], [["delay"]]), "false alarm"),
        (row("null", "data_sheet"), "right"),
        (row("null", "unrepeatable"), "no answer"),
        (row("null", "failed"), "no answer"),
        (row("library", "named", ["drag"], certain=["drag"]), "right"),
        (row("library", "named", ["drag"]), "right"),
        (row("library", "named", ["lag"], also=["lag"], certain=["lag"]), "right"),
        (row("library", "named", ["drag"], [["drag", "lag"]]), "ambiguous"),
        (row("library", "ambiguous", ["lag"], [["drag"]]), "ambiguous"),
        (row("library", "ambiguous", ["lag"], [["delay"]]), "likely wrong"),
        (row("library", "unknown"), "unknown"),
        (row("library", "unknown", ["lag"], certain=["lag"]), "certain wrong"),
        (row("library", "named", ["lag"]), "likely wrong"),
        (row("library", "named", ["lag"], certain=["lag"]), "certain wrong"),
        (row("library", "named", ["drag", "lag"], certain=["lag"]), "certain wrong"),
        (row("library", "none"), "missed"),
        (row("library", "none", **{"lambda": 2.0}), "right"),
        (row("denied", "unknown"), "right"),
        (row("denied", "named", ["lag"]), "ambiguous"),
        (row("denied", "ambiguous", ["lag"], [["delay"]]), "ambiguous"),
        (row("denied", "named", ["lag"], certain=["lag"]), "certain wrong"),
        (row("denied", "described", ["law"], certain=["law"], laws=["law"]), "ambiguous"),
        (row("denied", "described", ["law"], certain=["lag"], laws=["law"]), "certain wrong"),
        (row("library", "described", ["law"], [["drag"]], laws=["law"]), "ambiguous"),
        (row("library", "described", ["law"], certain=["law"], laws=["law"]), "certain wrong"),
        (row("null", "described", ["law"], laws=["law"]), "false alarm"),
        (row("denied", "none"), "missed"),
        (row("denied", "none", **{"lambda": 2.9}), "right"),
    ],
)
def test_what_an_answer_counts_as(given, wanted):
    assert outcome(given, {}) == wanted


@pytest.mark.parametrize(
    ("true", "null", "denied"),
    [
        (0.105, "right", "right"),
        (0.12, "false alarm", "right"),
        (0.2, "false alarm", "certain wrong"),
    ],
)
def test_a_certain_data_sheet_is_held_against_the_truth(true, null, denied):
    """Inside its interval, just outside of it, and far away."""
    said = {"sheets": {"mass": [0.1, 0.09, 0.11]}, "statuses": {"mass": "certain"}}
    said["stated"] = {"mass": ["data sheet", 1.0]}
    found = scored({**row("null", "data_sheet"), **said}, {"mass": true})
    assert found["outcome"] == null and found["is_certain"] == []
    assert found["held_sheets"]["mass"]["true"] == true
    assert scored({**row("denied", "unknown"), **said}, {"mass": true})["outcome"] == denied


def test_a_data_sheet_whose_truth_nobody_knows_is_no_excuse():
    sheets = held_sheets({}, {"mass": [0.1, 0.09, 0.11]})
    assert outcome(row("null", "data_sheet"), sheets) == "false alarm"


def test_sizes_are_held_against_what_is_said_of_named_causes_alone():
    inside = held_sizes(row("library", "named", ["drag"]))
    assert inside == {
        "drag": {"true": 0.1, "found": 0.11, "low": 0.09, "high": 0.12, "inside": True}
    }
    assert held_sizes(row("library", "unknown")) == {}
    assert held_sizes(row("denied", "named", ["drag"])) == {}
    unsized = row("library", "named", ["drag"])
    unsized["truth"]["sizes"]["drag"] = None
    assert held_sizes(unsized) == {}


def rows():
    """Ten cases, whose counts are known by hand."""
    made = [
        *(row("null", "none") for _ in range(3)),
        row("null", "unknown"),
        *(row("library", "named", ["drag"], certain=["drag"]) for _ in range(2)),
        row("library", "named", ["lag"], certain=["lag"]),
        row("library", "none", **{"lambda": 5.0}),
        row("denied", "unknown"),
        row("denied", "named", ["lag"], certain=["lag"]),
    ]
    return [{**r, **scored(r, {})} for r in made]


def test_rates_count_by_hand():
    found = {r.what: (r.hits, r.count) for r in rates(rows())}
    assert found == {
        "certain and wrong, cause in the library": (1, 4),
        "certain and wrong, cause denied": (1, 2),
        "false alarms, nothing hidden": (1, 4),
        "named or in the set, lambda >= 8": (2, 3),
        "sizes in their 90 % interval": (2, 2),
    }


def test_bounds_are_those_of_clopper_and_pearson():
    """No hit in n: the upper bound p solves (1 - p)^n = 5 %."""
    low, high = Rate("", "", 0, 29).bounds
    assert low == 0.0 and (1.0 - high) ** 29 == pytest.approx(0.05)
    assert Rate("", "", 0, 0).bounds == (0.0, 1.0)


def test_reliability_bins_what_was_stated():
    (last,) = reliability(rows())
    assert (last.low, last.count, last.hits) == (0.99, 4, 2)
    assert last.mean == pytest.approx(0.995)


def test_the_page_has_every_count(tmp_path):
    plan = {
        "sealed": False, "why_not_sealed": "the seed was given.", "commit": "0123456789abcdef",
        "master": 7, "effort": "quick", "date": "2026-11-23", "left_out": ["arm (mujoco)"],
        "machine": {"cpu": "x", "cores": 2, "instruction_set": "avx2", "torch": "2", "numpy": "2"},
    }  # fmt: skip
    page = write_page(rows(), plan, tmp_path / "rates.md").read_text()
    assert "A rehearsal, not sealed**: the seed was given. Commit 0123456789, master seed 7" in page
    assert "Left out, as not installed: arm (mujoco)" in page
    assert "| toy | denied | 2 | 1 |  |  |  | 1 |  |  |  | 2 |" in page
    assert "| toy_0004 | cart | drag (without its row) | 12.0 | clean | certain wrong |" in page
    assert "<svg" in (tmp_path / "rates.svg").read_text()
    read = list(csv.DictReader(io.StringIO((tmp_path / "rates.csv").read_text())))
    assert [r["outcome"] for r in read] == [r["outcome"] for r in rows()]
    assert csv_text(rows()) == (tmp_path / "rates.csv").read_text()


def test_bands_are_counted_pooled_and_at_the_farthest_runs():
    one, other = [["a", 90, 100, 1.0], ["b", 50, 100, 3.0]], [["c", 180, 200, 1.5]]
    lines = band_lines([{"bands": one}, {"bands": other}, {"bands": []}, {}])
    assert lines[2:] == [
        "| all unseen | 3 | 1.5 | 80% | 67% |",
        "| the farthest of each case | 2 | 2.2 | 77% | 50% |",
    ]
    assert band_lines([{}]) == []


def test_the_command_that_moved_most_is_judged_where_two_stay():
    def study(*strokes):
        time = np.linspace(0.0, 6.0, 50)
        runs = [
            Run(f"r{k}{i}", time, stroke * np.sin(time)[:, None], {}, f"r{k}")
            for k, stroke in enumerate(strokes)
            for i in range(2)
        ]
        return Study("s", "s", (Channel("a", "m", "position"),), tuple(runs))

    kept = farthest_kept(study(1.0, 3.0, 2.0))
    assert [run.name for run in kept.test_runs] == ["r10", "r11"]
    few = study(1.0, 3.0)
    assert farthest_kept(few) is few


def test_what_went_wrong_is_listed():
    assert len(wrong_lines(rows())) == 2 + 3 and not wrong_lines(rows()[:1])
    assert len(outcome_table(rows())) == 2 + 3 + 3
