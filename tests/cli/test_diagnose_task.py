"""``diffsim diagnose command`` and ``worth``: a task's best command, and what a cause costs it."""

import csv
import json

import pytest

from diffsim.cli import main
from diffsim.data import save_study
from tests.systems.late_cart import fitted_cart

TASK = """
seconds: 0.4
every: 0.02
knots: 6
wanted:
  place: {course: "0.05*sin(4*t)*t", miss: 0.001}
"""


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    """Folder with a study, a task, and an extended model in its folder ``out``."""
    folder = tmp_path_factory.mktemp("cart")
    (folder / "out").mkdir()
    study, _, _ = fitted_cart(folder / "out")
    save_study(study, folder / "study")
    (folder / "task.yaml").write_text(TASK, encoding="utf-8")
    return folder


def _run(step, cart, *more):
    given = [str(cart / "study"), "--task", str(cart / "task.yaml"), "--out", str(cart / "out")]
    return main(["diagnose", step, *given, *more])


def test_command_is_a_table_of_commands_and_what_they_do(cart, capsys):
    assert _run("command", cart) == 0
    exact = float(capsys.readouterr().out.split("miss: ")[1].split()[0])
    with (cart / "out" / "command.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 21 and set(rows[0]) == {"time_s", "force", "place predicted"}
    assert max(abs(float(row["force"])) for row in rows) <= 4.0
    assert _run("command", cart, "--draws", "3") == 0
    robust = float(capsys.readouterr().out.split("miss: ")[1].split()[0])
    assert robust == pytest.approx(exact, rel=0.5)  # close: the posterior is narrow
    with (cart / "out" / "command.csv").open(encoding="utf-8") as file:
        assert list(csv.DictReader(file)) != rows


@pytest.mark.story  # two best commands
def test_worth_says_what_a_cause_costs(cart, capsys):
    assert _run("worth", cart) == 0
    said = capsys.readouterr().out
    found = json.loads((cart / "out" / "worth.json").read_text(encoding="utf-8"))
    assert {row["cause"] for row in found} == {"square_drag", "delay", "all"}
    words = {"square_drag": "square drag", "delay": "delay", "all": "all causes"}
    assert all(f"{name}: best miss" in said for name in words.values())
    page = (cart / "out" / "worth.html").read_text(encoding="utf-8")
    best = max(found, key=lambda row: row["bought"])
    assert best["bought"] == pytest.approx(best["whole"] - best["none"])
    places = {row["cause"]: page.index(f"mending {words[row['cause']]} buys") for row in found}
    assert 0 < places[best["cause"]] == min(places.values())


def test_a_mistake_in_the_task_names_its_key(cart, capsys):
    (cart / "wrong.yaml").write_text(TASK.replace("knots", "knot"), encoding="utf-8")
    given = [str(cart / "study"), "--task", str(cart / "wrong.yaml"), "--out", str(cart / "out")]
    assert main(["diagnose", "command", *given]) == 2
    assert "no key 'knot' here" in capsys.readouterr().err


def test_an_open_verdict_is_said(cart, capsys):
    model = cart / "out" / "extended_model.yaml"
    text = model.read_text(encoding="utf-8").replace("verdict: named", "verdict: ambiguous")
    (cart / "open.yaml").write_text(text, encoding="utf-8")
    assert _run("command", cart) == 0
    assert "verdict" not in capsys.readouterr().out
    assert _run("command", cart, "--model", str(cart / "open.yaml")) == 0
    assert "verdict ambiguous" in capsys.readouterr().out
