"""The script of a stranger's first hour: it finds each page's blocks, and does not run a checkout.

What the blocks do is tested by test_recipes and test_tutorials; the script runs from a wheel.
"""

import subprocess
import sys
from pathlib import Path

from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]


def test_every_page_has_blocks_that_compile():
    first_hour = load_script("first_hour.py")
    for name in first_hour.PAGES:
        kinds = {kind for kind, _ in first_hour.blocks(ROOT / name)}
        assert "python" in kinds, name
        compile(first_hour.script(ROOT / name), name, "exec")


def test_a_page_runs_in_its_order_and_a_stumble_is_told(tmp_path, capsys):
    first_hour = load_script("first_hour.py")
    page = tmp_path / "page.md"
    blocks = {"python": "print(1)", "yaml": "# a.yaml\nb: 1", "sh": "grep b a.yaml\nfalse"}
    page.write_text("".join(f"```{kind}\n{text}\n```\n" for kind, text in blocks.items()))
    (tmp_path / "page.py").write_text(first_hour.script(page))
    assert not first_hour.passes("page", [sys.executable, "page.py"], tmp_path)
    said = (tmp_path / "said.txt").read_text()
    assert "b: 1" in said and "CalledProcessError" in said
    assert "page: status 1" in capsys.readouterr().out


def test_a_checkout_is_refused(tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "first_hour.py"), str(ROOT)],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and "this is a checkout" in done.stderr
    assert list(tmp_path.iterdir()) == []
