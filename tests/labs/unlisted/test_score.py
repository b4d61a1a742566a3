"""What an answer counts as: hand-made reports against the truth of a recorded case."""

import argparse

import pytest

from diffsim.diagnose.judge.records import DATA_SHEET
from labs.unlisted import __main__ as command
from labs.unlisted.case import items, judged
from labs.unlisted.draw import drawn
from labs.unlisted.page import rates
from labs.unlisted.record import recorded, write
from labs.unlisted.score import scored

LAW = {
    "name": "law_1",
    "entry": {"kind": "force", "target": "shaft"},
    "variables": ["angle"],
    "memory": None,
    "form": "periodic",
    "formula": "a*sin(14*angle + b)",
    "numbers": {
        "amplitude": {"value": 2e-3, "low": 1.8e-3, "high": 2.2e-3, "unit": "N m"},
        "wave_number": {"value": 14.0, "low": 13.9, "high": 14.1, "unit": "1/rad"},
    },
    "sentence": "A torque at the shaft repeats 14 times a turn.",
    "status": "certain",
}
TRUTH = {
    "group": "unlisted",
    "entry": [{"kind": "force", "target": "shaft"}, {"kind": "rate", "target": "rate"}],
    "variables": [["angle"], ["encoder"]],
    "memory": [],
    "forms": ["periodic"],
    "numbers": {"amplitude": 2.1e-3, "wave_number": 15.0},
    "alike": [],
    "numbers_of_machine": {"inertia": 2e-3},
}


ERRORS = [
    {"before": 3.0, "after": 0.3, "noise": 2.0, "num_samples": 100},
    {"before": 1.0, "after": 0.1, "noise": 1.0, "num_samples": 100},
]


def report(*laws, verdict="described", gain=0.97, causes=(), **more):
    return {
        "verdict": verdict,
        "named": [],
        "rivals": [],
        "causes": list(causes),
        "base": [],
        "gain": {"value": gain},
        "described": {"laws": list(laws), "screen": []} if laws else None,
        **more,
    }


def cause(name, origin="effect", status="certain"):
    return {"name": name, "origin": origin, "status": status}


def test_a_right_law_is_right_and_each_size_is_held_for_itself():
    row = scored(TRUTH, report(LAW), ERRORS)
    assert row["place"] and row["variable"] and row["form"] and row["removed"]
    assert row["share_removed"] == pytest.approx(0.99) and row["share_said"] == 0.97
    assert {n: s["inside"] for n, s in row["sizes"].items()} == {
        "amplitude": True, "wave_number": False
    }  # fmt: skip
    assert row["certain_and_wrong"] == [] and row["num_laws"] == 1
    # the sign of an amplitude is a phase
    numbers = {"amplitude": {"low": -2.2e-3, "high": -1.8e-3}}
    assert scored(TRUTH, report({**LAW, "numbers": numbers}))["sizes"]["amplitude"]["inside"]


@pytest.mark.parametrize(
    ("change", "place", "variable"),
    [
        ({"entry": {"kind": "reading", "target": "encoder"}}, False, True),
        ({"variables": ["rate"]}, True, False),
        ({"variables": ["angle", "rate"]}, True, False),
        ({"memory": "slip"}, True, False),
    ],
)
def test_a_certain_law_with_another_place_or_variable_is_wrong(change, place, variable):
    row = scored(TRUTH, report({**LAW, **change}))
    assert (row["place"], row["variable"], row["form"]) == (place, variable, False)
    assert row["sizes"] == {} and row["certain_and_wrong"] == ["law law_1"]
    likely = scored(TRUTH, report({**LAW, **change, "status": "likely"}))
    assert likely["certain_and_wrong"] == []


def test_another_form_at_the_right_place_is_not_certain_and_wrong():
    row = scored(TRUTH, report({**LAW, "form": "power"}))
    assert row["place"] and row["variable"] and not row["form"]
    assert row["certain_and_wrong"] == [] and row["sizes"] == {}


def test_columns_are_known_with_their_unit_and_hidden_states_by_their_kind():
    truth = {**TRUTH, "variables": [["temp"]], "memory": ["heat", "work"]}
    law = {**LAW, "variables": ["temp [degC]"], "memory": "work"}
    assert scored(truth, report(law))["variable"]
    assert not scored(truth, report({**law, "memory": None}))["variable"]


def test_without_a_law_nothing_is_found_and_certain_names_are_wrong():
    causes = [cause("backlash"), cause("lag", status="likely"), cause("stop_above_at_cart")]
    answer = report(verdict="named", named=["backlash"], causes=causes, gain=0.4)
    row = scored({**TRUTH, "alike": ["stop_above"]}, answer)
    assert not row["place"] and not row["removed"]
    assert row["certain_and_wrong"] == ["backlash"]
    base = [{"name": "inertia", "low": 2.5e-3, "high": 2.7e-3, "finding": True}]
    sheet = report(causes=[cause("inertia", DATA_SHEET)], base=base)
    assert scored(TRUTH, sheet)["certain_and_wrong"] == ["data sheet of inertia"]
    assert scored(TRUTH, {"verdict": "failed", "error": "no"})["said"] == "no"


def test_cases_with_nothing_hidden_and_with_a_cause_of_the_library():
    sound = {"group": "sound", "numbers_of_machine": {}}
    assert scored(sound, report(verdict="none"))["false_find"] is False
    assert scored(sound, report(LAW))["false_find"] and scored(sound, report(LAW))["false_name"]
    unknown = scored(sound, report(verdict="unknown"))
    assert unknown["false_find"] and not unknown["false_name"]
    assert scored(sound, report(LAW))["certain_and_wrong"] == ["law law_1"]
    open_answer = report(verdict="ambiguous", rivals=[["lag"], []])
    assert scored(sound, open_answer)["false_find"] is False
    listed = {"group": "listed", "alike": ["dry_friction"], "numbers_of_machine": {}}
    kept = report(verdict="named", named=["dry_friction_at_cart"],
                  causes=[cause("dry_friction_at_cart")])  # fmt: skip
    row = scored(listed, kept)
    assert row["name_kept"] and row["certain_and_wrong"] == []
    assert not scored(listed, report(LAW, named=["dry_friction"]))["name_kept"]


def test_a_case_is_recorded_scored_and_counted_on_the_page(tmp_path, monkeypatch, capsys):
    """The command, with a hand-made answer in place of a diagnosis, and again without one."""

    def solve(item, out):
        folder = out / "cases" / f"{item['kind']}_{item['turn']}"
        case = drawn(item["master"], item["kind"], item["turn"])
        write(recorded(case, 2e-3), folder)
        place = case.machine.places[0]["name"]
        answer = report({**LAW, "entry": {"kind": "force", "target": place}, "numbers": {}})
        return {**item, **judged(folder, answer, ERRORS), "cpu_s": 1.0, "judge_failure": ""}

    plan = {"master": 5, "commit": "c" * 40, "effort": "quick", "sealed": False,
            "why_not_sealed": "the seed was given.", "date": "2026-01-01",
            "machine": {"cpu": "x", "cores": 1, "instruction_set": "y"}}  # fmt: skip
    monkeypatch.setattr(command, "planned", lambda args: plan)
    monkeypatch.setattr(command, "solve", solve)
    call = ["--only", "cogging", "--cases", "2", "--out", str(tmp_path), "--seed", "5"]
    assert command.main(call) == 0
    page = (tmp_path / "unlisted.md").read_text()
    assert "2 of 1 kinds hide a law" in page and "| cogging_1 |" in page
    assert "place and variable right | >= 85 % | 100.0%" in page
    monkeypatch.setattr(command, "solve", lambda item, out: pytest.fail("made again"))
    assert command.main(call) == 0
    assert (tmp_path / "unlisted.md").read_text() == page
    assert command.main(["--only", "coging", "--out", str(tmp_path)]) == 2
    assert "did you mean 'cogging'" in capsys.readouterr().err


def test_each_kind_comes_once_before_any_comes_again():
    plan = {"master": 1, "commit": "c", "effort": "quick"}
    assert list(items(("cogging", "slosh"), 3, plan)) == ["cogging_0", "slosh_0", "cogging_1"]
    row = {"group": "sound", "false_find": True, "false_name": False, "certain_and_wrong": []}
    found = {rate.what: rate.hits for rate in rates([{**row, "verdict": "unknown"}])}
    assert found["not `none` where nothing is hidden"] == 1
    assert found["a law or a cause where nothing is hidden"] == 0
    assert isinstance(command.arguments(), argparse.ArgumentParser)
