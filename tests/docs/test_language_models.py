"""What a language model is told: the page and the skill are one, and their commands exist."""

import re
from pathlib import Path

import yaml

from diffsim.cli import main
from diffsim.cli.main import parser

PROJECT = Path(__file__).resolve().parents[2]


def test_the_shipped_skill_is_the_page(capsys):
    assert main(["info", "--skill"]) == 0
    skill = capsys.readouterr().out
    _, head, body = skill.split("---\n", 2)
    assert set(yaml.safe_load(head)) == {"name", "description"}
    assert body.lstrip() == (PROJECT / "docs/for_language_models.md").read_text("utf-8")


def test_commands_that_a_language_model_is_told_parse():
    text = (PROJECT / "docs/for_language_models.md").read_text("utf-8")
    said = re.findall(r"`(?:diffsim )?((?:diagnose|data|info)\b[^`]*)`", text)
    assert len(said) >= 12
    for line in said:
        parser().parse_args(line.replace("KIND", "ode").split())


def test_statuses_and_verdicts_are_those_of_the_report():
    from diffsim.diagnose.judge.records import STATUSES
    from diffsim.diagnose.say.wording import VERDICTS

    text = (PROJECT / "docs/for_language_models.md").read_text("utf-8")
    assert all(f"`{word}`" in re.sub(r"\s+", " ", text) for word in (*STATUSES, *VERDICTS))
