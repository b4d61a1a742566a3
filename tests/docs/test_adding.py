"""docs/adding.md is true: its files exist, and what is added as it says works, to a verdict."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "adding.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`((?:diffsim|csrc|tests|scripts)/[\w./]+\.(?:py|h|cpp))`")


def test_every_file_that_is_named_exists():
    named = set(NAMED.findall(PAGE))
    assert len(named) > 8
    named = {name.replace("KIND", "soft_body") for name in named}
    templates = {name for name in named if "NAME" in name}
    assert [n for n in sorted(named - templates) if not (ROOT / n).is_file()] == []
    assert all((ROOT / n).parent.is_dir() for n in templates)


def test_entry_points_are_the_groups_that_are_read():
    from diffsim.core import plugins

    groups = set(re.findall(r'entry-points\."(diffsim\.\w+)"', PAGE))
    assert groups == {plugins.ENVIRONMENTS, plugins.DEVICES, plugins.SYSTEMS}


ADDED = Path(__file__).parent / "added"
COPIED = ("causes", "systems", "data", "data/formats")  # folders in which something changes
KEYS = {
    "force: TODO": "force: cmd_force_N",
    "stiffness: TODO": "stiffness: {value: 100 N/m, percent: 20}",
}
DIAGNOSE = """
import json, sys
from pathlib import Path

sys.modules |= dict.fromkeys(("matplotlib", "plotly", "rerun"))  # pictures take longer than this
from diffsim.cli.main import main

folder, keys = Path(sys.argv[1]), json.loads(sys.argv[2])
assert main(["diagnose", "init", str(folder), "--system", "spring"]) == 0
study = folder / "study.yaml"
text = study.read_text()
for old, new in keys.items():
    assert old in text, text
    text = text.replace(old, new)
study.write_text(text)
assert main(["diagnose", "check", str(study)]) == 0
assert main(["diagnose", "explain", str(study), "--out", str(folder / "answer")]) == 0
assert main(["diagnose", "schema", "--out", str(folder / "schema.json")]) == 0
"""


def copy_of_package(folder):
    """The package as links, and as folders of links where something is added to it."""
    made = folder / "diffsim"
    for inner in ("", *COPIED):
        (made / inner).mkdir()
        for path in (ROOT / "diffsim" / inner).iterdir():
            there = (Path(inner) / path.name).as_posix()
            if there not in COPIED and path.name != "__pycache__":
                (made / there).symlink_to(path)
    return made


def change(path, old, new):
    """Replace a text of a file of the copy, which is a link until then."""
    text = path.read_text()
    assert old in text
    path.unlink()
    path.write_text(text.replace(old, new, 1))


def pulled(seed):
    """Columns of a spring that is 5 mm longer at rest than anybody told."""
    rng = np.random.default_rng(seed)
    time = 0.5 * np.arange(20.0)
    force = (2.0 + seed) * np.abs(np.sin(time + seed))
    shown = force / 100.0 + 5e-3 + 1e-4 * rng.standard_normal(len(time))
    return {"time_s": time, "cmd_force_N": force, "extension_m": shown}


def add_a_kind_and_a_format(folder):
    """To a copy of the package: what docs/adding.md says, and nothing else."""
    made = copy_of_package(folder)
    kind = made / "systems" / "spring"
    kind.mkdir()
    (kind / "__init__.py").write_text("")
    (kind / "description.py").symlink_to(ADDED / "spring.py")
    (made / "causes" / "spring.yaml").symlink_to(ADDED / "spring.yaml")
    line = '"spring": ("diffsim.systems.spring.description", "SpringDescription"),'
    opened = "DESCRIPTIONS = {\n"
    change(made / "systems" / "registry.py", opened, f"{opened}    {line}\n")
    formats = made / "data" / "formats"
    (formats / "triples.py").symlink_to(ADDED / "triples.py")
    opened = "_READERS: dict[str, tuple[Parts, Read]] = {\n"
    line = '".triples": (triples.parts, triples.read),'
    change(formats / "registry.py", opened, f"{opened}    {line}\n")
    change(formats / "registry.py", "import arrays,", "import triples, arrays,")


@pytest.mark.story  # a page, with a diagnosis in a process of its own
def test_a_kind_with_its_causes_and_a_format_work_to_a_verdict(tmp_path):
    add_a_kind_and_a_format(tmp_path)
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    for k in range(4):
        columns = pulled(k)
        lines = [
            f"{t:g};{name};{value:.6g}"
            for name in ("cmd_force_N", "extension_m")
            for t, value in zip(columns["time_s"], columns[name], strict=True)
        ]
        (recorded / f"pull_{k}.triples").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, "-c", DIAGNOSE, str(recorded), json.dumps(KEYS)],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "rest" in done.stdout
    keys = json.loads((recorded / "schema.json").read_text())["$defs"]
    assert any({"force", "stiffness"} <= set(part.get("properties", ())) for part in keys.values())
