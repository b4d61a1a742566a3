"""Messages of the page for troubleshooting and words for language models are the package's."""

import re
from pathlib import Path

import pytest
import yaml

from diffsim.cli import main
from diffsim.cli.main import parser

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
OF_OTHERS = ("No module named 'diffsim'",)
MESSAGES = [
    message
    for row in re.findall(r"^\| (.*?) \|", PAGE, re.M)
    for message in re.findall(r"`([^`]+)`", row)
    if message not in OF_OTHERS and not message.startswith("diffsim ")
]


def said():
    """Texts of all modules, lines of one string joined."""
    files = sorted((ROOT / "diffsim").rglob("*.py"))
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    return " ".join(re.sub(r'"\s*\n\s*f?"', "", text).split())


@pytest.fixture(scope="module")
def package():
    return said()


def test_there_are_messages():
    assert len(MESSAGES) > 20


@pytest.mark.parametrize("message", MESSAGES)
def test_the_package_says_it(package, message):
    for part in message.split("..."):
        for words in re.split(r"\d+ m |: ", part):
            assert words.strip() in package, words


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
