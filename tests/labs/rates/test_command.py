"""The command from drawing to page: sealed or not, interrupted, gone on with."""

import json

import pytest

from labs.rates import __main__ as command
from labs.rates import case as case_module
from labs.rates import plan as plan_module
from labs.rates.case import solve
from labs.rates.draw import draw
from labs.rates.strength import size_for
from labs.rates.table import csv_text, outcome_table


@pytest.fixture
def clean(monkeypatch):
    """A tree without changes."""
    monkeypatch.setattr(plan_module, "head", lambda: ("c" * 40, ""))


def call(folder, *more):
    return command.main(["--domain", "bench", "--n", "2", "--out", str(folder), *more])


@pytest.mark.cpu(8)
def test_cases_are_diagnosed_counted_and_never_twice(tmp_path, clean, monkeypatch, capsys):
    """The second of two cases is interrupted: the same command goes on with that one alone."""

    def stopped(item):
        if item["index"] == 1:
            raise KeyboardInterrupt
        return solve(item)

    monkeypatch.setattr(command, "solve", stopped)
    assert call(tmp_path, "--master", "5") == 130
    assert "go on with: python -m labs.rates --domain bench" in capsys.readouterr().err
    kept = {p.name: p.read_text() for p in (tmp_path / "cases").glob("*.json")}
    assert set(kept) == {"bench_0000.json"}
    done = []
    monkeypatch.setattr(command, "solve", lambda item: done.append(item["index"]) or solve(item))
    assert call(tmp_path) == 0
    assert done == [1]
    assert (tmp_path / "cases" / "bench_0000.json").read_text() == kept["bench_0000.json"]
    (row,) = (json.loads(p.read_text())["result"] for p in tmp_path.glob("cases/*_0001.json"))
    assert row["outcome"] != "no answer" and row["truth"]["sizes"] and row["simulations"] > 0
    assert all(0 <= inside <= count for _, inside, count, _ in row["bands"]) and row["bands"]
    page = (tmp_path / "rates.md").read_text()
    assert "| all unseen | 2 |" in page
    assert "master seed 5" in page and "2 cases (2 bench)" in page
    # a case can be asked for alone; the page counts all that have ended
    assert call(tmp_path, "--only", "bench_0001") == 0
    assert done == [1] and (tmp_path / "rates.md").read_text() == page


def test_a_run_is_sealed_only_by_a_fresh_seed_from_a_clean_tree(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "solve", lambda item: pytest.fail("a case was made"))
    monkeypatch.setattr(command, "wanted", lambda args, plan: {})
    monkeypatch.setattr(command, "write_pages", lambda rows, plan, args: args.out)
    monkeypatch.setattr(plan_module, "head", lambda: ("a" * 40, ""))
    assert call(tmp_path / "fresh") == 0
    assert ", sealed" in capsys.readouterr().out
    plan = json.loads((tmp_path / "fresh" / "plan.json").read_text())
    assert plan["sealed"] and plan["commit"] == "a" * 40 and plan["machine"]["cores"]
    # it goes on with its own seed, and not with another one, another effort or another commit
    assert call(tmp_path / "fresh") == 0
    assert f"master seed {plan['master']}" in capsys.readouterr().out
    assert call(tmp_path / "fresh", "--master", "5") == 2
    assert call(tmp_path / "fresh", "--effort", "full") == 2
    assert call(tmp_path / "fresh", "--far") == 2
    assert call(tmp_path / "given", "--master", "5") == 0
    assert "not sealed: the seed was given" in capsys.readouterr().out
    monkeypatch.setattr(plan_module, "head", lambda: ("a" * 40, "diffsim/x.py"))
    assert call(tmp_path / "fresh") == 2
    assert "a clean tree, and diffsim/x.py differs" in capsys.readouterr().err
    assert call(tmp_path / "dirty") == 0
    assert "not sealed: diffsim/x.py was changed" in capsys.readouterr().out
    monkeypatch.setattr(plan_module, "head", lambda: ("b" * 40, ""))
    assert call(tmp_path / "fresh") == 2
    assert "holds a run of commit aaaa" in capsys.readouterr().err


def test_unknown_domains_are_refused(tmp_path, capsys):
    assert command.main(["--domain", "tyo", "--out", str(tmp_path)]) == 2
    assert "did you mean 'toy'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_sizes_meet_the_visibility_that_is_wanted():
    case = next(c for c in (draw(1, "bench", k) for k in range(1, 60, 3)) if 9.0 < c.wanted < 12.0)
    size, strength = size_for(case)
    assert size > 0.0 and 0.8 < strength / case.wanted < 1.25


def test_a_case_that_cannot_be_recorded_counts_as_no_answer(monkeypatch):
    """It stays in the table, and does not end the run."""

    def fail(*_):
        raise RuntimeError("no equilibrium")

    monkeypatch.setattr(case_module, "size_for", fail)
    item = {"master": 1, "domain": "toy", "index": 1, "effort": "quick"}
    row = solve(item)
    assert (row["outcome"], row["verdict"]) == ("no answer", "not made")
    assert row["error"] == "RuntimeError: no equilibrium"
    assert "| toy | in the library | 1 |" in "".join(outcome_table([row]))
    assert csv_text([row]).count("\n") == 2
