"""docs/study_keys.md is what the classes of the keys say; every key says something."""

import importlib.util
from importlib import import_module

import pytest

from diffsim.core.schema_keys import blocks_of, keys_of
from diffsim.data.study_schema import Fact, StudyFile
from diffsim.systems.registry import DESCRIPTIONS
from tests.scripts import load_script


def descriptions():
    for module, name in DESCRIPTIONS.values():
        if importlib.util.find_spec(module.rpartition(".")[0]) and importlib.util.find_spec(module):
            yield getattr(import_module(module), name)


def test_page_is_up_to_date():
    """Where this fails: python scripts/study_keys_page.py."""
    module = load_script("study_keys_page.py")
    below = module.PAGE.read_text(encoding="utf-8").partition(module.MARK)[2]
    assert below == f"\n{module.page()}"


@pytest.mark.parametrize("root", [StudyFile, Fact, *descriptions()], ids=lambda c: c.__name__)
def test_every_key_says_what_it_means(root):
    silent = [
        f"{block.__name__}.{key.name}"
        for block in blocks_of(root)
        for key in keys_of(block)
        if len(key.meaning) < 3 or key.kind in ("anything", "")
    ]
    assert not silent
