"""docs/adding.md names files that exist: who adds something opens these."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "adding.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`((?:diffsim|csrc|tests|scripts)/[\w./]+\.(?:py|h|cpp))`")


def test_every_file_that_is_named_exists():
    named = set(NAMED.findall(PAGE))
    assert len(named) > 8
    templates = {name for name in named if "NAME" in name}
    assert [n for n in sorted(named - templates) if not (ROOT / n).is_file()] == []
    assert all((ROOT / n).parent.is_dir() for n in templates)


def test_entry_points_are_the_groups_that_are_read():
    from diffsim.core import plugins

    groups = set(re.findall(r'entry-points\."(diffsim\.\w+)"', PAGE))
    assert groups == {plugins.ENVIRONMENTS, plugins.DEVICES, plugins.SYSTEMS}
