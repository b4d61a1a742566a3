"""Every key of users' files that names a file is attacked; the list is drawn from the schema.

A new key that says it names a file, or whose meaning mentions one, fails here until it has a case.
"""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from diffsim import envs
from diffsim.copter import load_design
from diffsim.copter.exchange.vehicle_file import load_vehicle
from diffsim.core.schema_keys import keys_of
from diffsim.core.schema_paths import CODE, INSIDE
from diffsim.data import load_study
from diffsim.mesh import load_surface
from diffsim.systems.registry import setup_of
from tests.envs.soft_files import finger, with_model
from tests.scripts import load_script

ROOT = Path(__file__).parent.parent
PUBLISHED = ROOT / "diffsim" / "systems" / "published"
SECRET = "time_s,secret,word\n0,1,hunter2\n1,2,hunter2\n"
MESSAGE = r"must (stay in|be a path relative to) its folder|cannot be followed"


def study(**keys: Any) -> Callable[[Path], object]:
    """A study, read, and its model made."""
    own = {
        "name": "cart",
        "system": "rigid_body",
        "channels": [{"name": "secret", "unit": "m"}],
        "runs": [{"name": "a", "file": "own.csv"}],
    }
    if "model" in keys:
        own.pop("system")

    def read(folder: Path) -> object:
        (folder / "study.yaml").write_text(yaml.safe_dump(own | keys))
        found = load_study(folder)
        return setup_of(found) if "model" in keys else found

    return read


def written(content: dict[str, Any], read: Callable[[Path], object]) -> Callable[[Path], object]:
    """A file of another kind."""

    def attack(folder: Path) -> object:
        (folder / "it.yaml").write_text(yaml.safe_dump(content))
        return read(folder / "it.yaml")

    return attack


def ball(path: str) -> dict[str, Any]:
    keys = yaml.safe_load((PUBLISHED / "tennis_balls.yaml").read_text())
    keys["model"]["camera"]["points"]["file"] = path
    return {"model": keys["model"], "channels": keys["channels"]}


def copter(path: str) -> dict[str, Any]:
    sensors = {"position": ["x", "y", "z"]}
    commands = {"columns": ["n1", "n2", "n3", "n4"], "as": "speed"}
    frames = {"world": "ENU", "body": "FLU"}
    model = {"system": "multicopter", "design": path, "frames": frames}
    model |= {"thrust": {"coefficient": 1e-5}}
    return {
        "model": {**model, "sensors": sensors, "commands": commands},
        "channels": [{"name": name, "unit": "m"} for name in "xyz"],
        "commands": [{"name": name, "unit": "rad/s"} for name in commands["columns"]],
    }


def task(**keys: Any) -> Callable[[Path], object]:
    return written(keys, envs.make_task)


def part(kind: str) -> Callable[[str], Callable[[Path], object]]:
    mounts = {"nose": {"center": [0, 0, 0], "normal": [0, 0, -1]}}
    further = {
        "mesh_frame": {"mounts": mounts},
        "imported_mesh": {"density": 1.0},
        "imported_rod": {"density": 1.0, "length": 1.0},
        "imported_motor": {"density": 1.0, "rotor": "kde2814_10in", "spin": "cw"},
    }[kind]
    return lambda path: written(
        {"parts": {"frame": {"kind": kind, "file": path, **further}}}, load_design
    )


VEHICLE = {
    "body": "FLU",
    "rotors": [{"at": [0, 0, 0], "spin": "cw"}],
    "rotor": {"radius": 0.1, "max_thrust": 5, "torque_ratio": 0.01},
}
OUTSIDE = {"system": "outside", "parameters": {}}
MJCF = "diffsim.systems.outside.mjcf:Mjcf"
CASES: dict[tuple[str, str], Callable[[str], Callable[[Path], object]]] = {
    ("StudyFile", "like"): lambda path: study(like=path),
    ("RunEntry", "file"): lambda path: study(runs=[{"name": "a", "file": path}]),
    ("RunEntry", "table"): lambda path: study(runs=[{"table": path, "file": "{word}.csv"}]),
    ("OutsideDescription", "simulator"): lambda path: study(
        model=OUTSIDE | {"simulator": f"{path}.py:Sim"}
    ),
    ("OutsideDescription", "options"): lambda path: study(
        model=OUTSIDE | {"simulator": MJCF, "options": {"model": path}}
    ),
    ("MulticopterKeys", "design"): lambda path: study(**copter(path)),
    ("Points", "file"): lambda path: study(**ball(path)),
    ("MeshFile", "path"): lambda path: task(
        **with_model(finger(), body={"file": {"path": path, "spacing": 0.01}})
    ),
    ("SoftTaskKeys", "extended_model"): lambda path: task(**finger(extended_model=path)),
    ("VehicleFile", "body_file"): lambda path: written(
        {**VEHICLE, "body_file": path}, load_vehicle
    ),
    **{
        ("task: CopterHover", key): lambda path, key=key: task(**{"task": "CopterHover", key: path})
        for key in ("vehicle", "design", "model")
    },
    **{
        (f"kind: {kind}", "file"): part(kind)
        for kind in ("mesh_frame", "imported_mesh", "imported_rod", "imported_motor")
    },
}
NO_PATHS = {"name", "column", "columns", "value", "velocities", "groups", "group", "body", "model"}
NO_PATHS |= {"rotor_model"}  # the name of a shipped one

_opened: list[str] | None = None


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if _opened is not None and event == "open":
        _opened.append(str(arguments[0]))


sys.addaudithook(_note)


@contextmanager
def noting_files() -> Iterator[list[str]]:
    """Names of the files that Python opens meanwhile."""
    global _opened
    _opened = []
    try:
        yield _opened
    finally:
        _opened = None


def test_every_key_that_names_a_file_is_attacked_here_and_listed():
    """Where the list differs: python scripts/security_page.py."""
    module = load_script("security_page.py")
    stated = module.stated_paths()
    assert {(p.block, p.key) for p in stated if p.reach in (INSIDE, CODE)} == set(CASES)
    between = module.PAGE.read_text(encoding="utf-8").partition(module.MARKS[0])[2]
    assert between.partition(module.MARKS[1])[0] == module.table()
    for block in module.blocks():
        for key in keys_of(block):
            mentions = re.search(
                r"\b(file|folder|path|module|shipped)\b", f"{key.name} {key.meaning}"
            )
            if mentions and key.reach is None and re.search(r"text|anything|column", key.kind):
                assert key.name in NO_PATHS, f"{block.__name__}.{key.name} mentions {mentions[0]}"


@pytest.mark.parametrize("where", CASES, ids=" ".join)
def test_what_a_file_names_stays_in_its_folder(tmp_path, where):
    folder = tmp_path / "theirs"
    folder.mkdir()
    (tmp_path / "secret.csv").write_text(SECRET)
    (tmp_path / "secret.csv.py").write_text("Sim = print('hunter2')\n")
    names = [
        *"xyz",
        *(f"n{k}" for k in range(1, 5)),
        *(f"ball{k}_{c}_px" for k in (0, 1) for c in "uv"),
    ]
    rows = ["time_s,secret," + ",".join(names), *(f"{t}" + ",1" * (1 + len(names)) for t in (0, 1))]
    (folder / "own.csv").write_text("\n".join(rows))
    (folder / "up").symlink_to(tmp_path)
    for suffix in ("", ".py"):
        (folder / f"link.csv{suffix}").symlink_to(tmp_path / f"secret.csv{suffix}")
    ways = (str(tmp_path / "secret.csv"), "../secret.csv", "a/../../secret.csv", "link.csv",
            "up/secret.csv", r"..\secret.csv", r"C:\secret.csv")  # fmt: skip
    for way in ways:
        with noting_files() as opened, pytest.raises(ValueError, match=MESSAGE) as refused:
            CASES[where](way)(folder)
        assert "hunter2" not in str(refused.value)
        assert where[1] in str(refused.value) or where[0].startswith("kind")
        assert not [name for name in opened if "secret.csv" in name or "link.csv" in name]


def test_surfaces_read_no_other_file(tmp_path):
    """Materials of an OBJ file were looked for wherever it said."""
    (tmp_path / "theirs").mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd secret.png\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    path = tmp_path / "theirs" / "it.obj"
    path.write_text(f"mtllib ../secret.mtl\n{corners}usemtl a\n{faces}")
    with noting_files() as opened:
        assert len(load_surface(path).faces) == 4
    assert {name for name in opened if str(tmp_path) in name} == {str(path)}
