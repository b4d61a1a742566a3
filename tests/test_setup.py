"""The build: kernels are compiled alike under every Python, each file once; wheels have scripts."""

import ast
import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from diffsim.cli import examples
from diffsim.core import paths
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
SETUP = ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))


def taken(*names: str) -> dict:
    """Functions and constants of setup.py, without running the rest of it."""
    kept = [
        node
        for node in SETUP.body
        if getattr(node, "name", None) in names
        or (isinstance(node, ast.Assign) and getattr(node.targets[0], "id", None) in names)
    ]
    space: dict = {"re": re, "hashlib": hashlib, "os": os, "Path": Path}
    exec(compile(ast.Module(kept, []), "setup.py", "exec"), space)
    return space


@pytest.mark.parametrize(
    "command",  # of Python 3.10, 3.11, and of 3.12 and later
    [
        "g++ -Wno-unused-result -Wsign-compare -DNDEBUG -g -fwrapv -O3 -Wall -fPIC",
        "g++ -Wsign-compare -DNDEBUG -g -fwrapv -O3 -Wall -fPIC",
        "g++ -fno-strict-overflow -Wsign-compare -DNDEBUG -g -O3 -Wall -fPIC",
    ],
)
def test_kernels_are_compiled_alike_under_every_python(command):
    of_kernels = taken("of_kernels", "PYTHONS_OWN")["of_kernels"]
    expected = ["g++", "-Wsign-compare", "-DNDEBUG", "-g", "-fwrapv", "-O3", "-Wall", "-fPIC"]
    assert of_kernels(command.split()) == expected
    assert of_kernels([]) == [] and of_kernels(["ccache", "g++"]) == ["ccache", "g++", "-fwrapv"]


UNITS = (
    *("UNITY", "UNIT_FOLDERS", "UNIT_LINES", "read", "includes_eigen", "even_shares", "groups_of"),
    *("unit_text", "write_units", "is_kernel", "sources_of", "content_hash"),
)


def cpp_files() -> list[str]:
    """All sources below csrc, as the extension names them."""
    return sorted(str(p.relative_to(ROOT)) for p in (ROOT / "csrc").rglob("*.cpp"))


@pytest.mark.parametrize("unity", ["1", "0"])
def test_every_source_is_compiled_exactly_once(unity, monkeypatch):
    monkeypatch.setenv("DIFFSIM_UNITY", unity)
    monkeypatch.chdir(ROOT)
    build = taken(*UNITS)
    units = build["groups_of"](cpp_files())
    assert sorted(name for members in units.values() for name in members) == cpp_files()
    assert (len(units) == len(cpp_files())) == (unity == "0")
    for name, members in units.items():
        assert all(build["is_kernel"](member) == build["is_kernel"](name) for member in members)
        assert len({Path(member).parent for member in members}) == 1
        if name in cpp_files():
            assert members == [name]
        else:
            included = re.findall(r'#include "(.*)"', build["unit_text"](members))
            assert [f"csrc/{member}" for member in included] == members


def test_units_are_of_like_size_and_keep_eigen_apart(monkeypatch):
    monkeypatch.setenv("DIFFSIM_UNITY", "1")
    monkeypatch.chdir(ROOT)
    build = taken(*UNITS)
    units = build["groups_of"](cpp_files())
    kernels = [m for name, m in units.items() if build["is_kernel"](name)]
    lines = [sum(build["read"](Path(p)).count("\n") for p in members) for members in kernels]
    assert max(lines) < 1.5 * build["UNIT_LINES"]
    for members in kernels:
        assert len({build["includes_eigen"](member) for member in members}) == 1
    folders = {Path(p).parent.relative_to("csrc").as_posix() for m in kernels for p in m[1:]}
    assert folders == set(build["UNIT_FOLDERS"])
    assert build["includes_eigen"]("csrc/kernels/copter/box_qp.cpp")  # through its header
    assert not build["includes_eigen"]("csrc/kernels/linalg/aggregation.cpp")


def test_an_object_is_of_all_members_of_its_unit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    build = taken(*UNITS)
    folder = tmp_path / "csrc" / "kernels"
    folder.mkdir(parents=True)
    names = [f"csrc/kernels/{name}" for name in ("a.cpp", "b.cpp", "both.h")]
    for name in names:
        Path(name).write_text("int x;\n")
    unit, rule = "build/units/kernels-0.cpp", Path("kernels-0.d")
    build["write_units"]({unit: names[:2], names[2]: [names[2]]})
    rule.write_text(f"kernels-0.o: {unit} {names[0]} \\\n {names[1]} {names[2]} /usr/include/x.h\n")
    seen = {build["content_hash"](rule)}
    for name in (*names, unit):  # a member, a header, and who is a member
        Path(name).write_text("int y;\n")
        seen.add(build["content_hash"](rule))
    assert len(seen) == 5
    build["write_units"]({unit: names[:2]})
    assert Path(unit).read_text() == build["unit_text"](names[:2])


def test_units_that_stand_are_not_written_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_units = taken(*UNITS)["write_units"]
    units = {"build/units/u-0.cpp": ["csrc/a.cpp", "csrc/b.cpp"]}
    write_units(units)
    os.utime("build/units/u-0.cpp", (1.0, 1.0))
    write_units(units)
    assert os.stat("build/units/u-0.cpp").st_mtime == 1.0


@pytest.mark.parametrize(
    ("wanted", "names"),
    [
        ("native", {"avx2"}),
        ("none", set()),
        ("all", {"baseline", "avx2"}),
        ("baseline,native", {"baseline", "avx2"}),
    ],
)
def test_instruction_sets_are_chosen_by_name(wanted, names):
    build = taken("chosen")
    build["INSTRUCTION_SETS"] = {"baseline": [], "avx2": []}
    assert build["chosen"](wanted, "avx2") == names
    with pytest.raises(SystemExit, match="choose from native, all, none, baseline, avx2"):
        build["chosen"]("sse9", "avx2")


def test_setup_installs_what_the_build_requires():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    script = (ROOT / "scripts" / "setup").read_text(encoding="utf-8")
    required = re.findall(r"^requires = \[(.*)\]$", project, re.M)
    installed = re.findall(r"^build_requirements=\((.*)\)$", script, re.M)
    assert [re.findall(r'"([^"]+)"', words) for words in required + installed] == 2 * [
        re.findall(r'"([^"]+)"', required[0])
    ]


def test_scripts_of_the_checkout_are_found_and_shipped():
    assert paths.SCRIPTS == ROOT
    assert set(taken("SCRIPTS")["SCRIPTS"]) == {"examples", "labs/balls", "labs/loop", "rl"}
    found = examples.examples()
    assert found["train_ppo"].group == "rl" and found["sliding_block"].group == "contact"


def test_all_pages_and_scripts_of_templates_are_packaged():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    patterns = re.findall(r'"templates/\*\.(\w+)"', project)
    present = {p.suffix[1:] for p in (ROOT / "diffsim" / "viz" / "templates").iterdir()}
    assert present == set(patterns)


PIP_LISTS = """\
:env:.cert='/etc/ssl/own.crt'
:env:.config-file='/home/me/pip.conf'
global.constraint='/etc/pip/newest.txt'
global.extra-index-url='https://one.example/simple https://two.example/simple'
global.find-links='/opt/wheels'
install.find-links='/home/me/wheels /opt/wheels'
:env:.disable-pip-version-check='1'
wheel.no-index='1'
"""


def test_uv_installs_from_where_pip_would():
    settings = load_script("uv_settings.py")
    assert settings.environment_of(settings.settings_of(PIP_LISTS)) == {
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        "UV_CONSTRAINT": "constraints.txt /etc/pip/newest.txt",
        "UV_INDEX": "https://one.example/simple https://two.example/simple",
        "UV_FIND_LINKS": "/home/me/wheels,/opt/wheels",  # the section of `pip install` is nearer
        "SSL_CERT_FILE": "/etc/ssl/own.crt",
    }


@pytest.mark.parametrize("name", ["client-cert", "no-binary", "pre", "target"])
def test_pip_installs_where_uv_has_no_twin_of_a_setting(name):
    settings = load_script("uv_settings.py")
    listed = f"{PIP_LISTS}global.{name}='x'\n"
    assert settings.environment_of(settings.settings_of(listed)) is None


def test_settings_that_pip_lists_here_are_read():
    settings = load_script("uv_settings.py")
    pip = [sys.executable, "-m", "pip", "config", "list"]
    env = {**os.environ, "PIP_INDEX_URL": "https://own.example/simple", "PIP_TIMEOUT": "7"}
    listed = subprocess.run(pip, env=env, capture_output=True, text=True, check=True).stdout
    found = settings.settings_of(listed)
    assert (found["index-url"], found["timeout"]) == ("https://own.example/simple", "7")
