"""What is refused, or only asked, loads no simulator: a quarter of a second instead of four."""

import subprocess
import sys

import pytest

ASKED = """
import sys
from diffsim.cli import main
status = main(sys.argv[1:])
print("LOADED", status, *({"torch", "scipy", "pandas", "matplotlib"} & set(sys.modules)))
"""


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["diagnose", "init", "{tmp}/none"], 2),
        (["diagnose", "init", "{tmp}/empty"], 2),
        (["diagnose", "init", "{tmp}/there"], 2),
        (["info"], 0),
    ],
)
def test_no_simulator_is_loaded(tmp_path, arguments, status):
    (tmp_path / "empty").mkdir()
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "study.yaml").write_text("name: there\n")
    arguments = [a.format(tmp=tmp_path) for a in arguments]
    done = subprocess.run(
        [sys.executable, "-c", ASKED, *arguments], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == f"LOADED {status}"


def test_quiet_shows_no_progress(capsys):
    from diffsim.core.progress import hide_progress, show_progress

    try:
        hide_progress(True)
        assert list(show_progress(range(3), desc="work")) == [0, 1, 2]
        assert capsys.readouterr().err == ""
    finally:
        hide_progress(False)
    assert list(show_progress(range(3), desc="work")) == [0, 1, 2]
    assert "work" in capsys.readouterr().err
