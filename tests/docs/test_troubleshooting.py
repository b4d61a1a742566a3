"""Messages on the page for troubleshooting are those of the package."""

import re
from pathlib import Path

import pytest

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
