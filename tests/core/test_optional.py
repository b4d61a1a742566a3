"""Optional packages: what is missing is said before work starts, with a command that works."""

import re

import pytest

from diffsim.core import optional as home
from diffsim.core.optional import advice, ask_for, optional


def test_the_advice_is_what_pip_knows():
    """The packages themselves, which works from a checkout, too; the extra stands beside."""
    for module, name, extra in (
        ("osqp", "osqp", "opt"),
        ("stable_baselines3", "stable-baselines3", "rl"),
        ("cv2", "opencv-python-headless", "video"),
    ):
        said = rf"pip install '{name}>=[\d.]+' \(extra {extra} of diffsim-robot\)"
        assert re.fullmatch(said, advice([module]))
    assert advice(["osqp", "cv2"]).endswith(" (extras opt, video of diffsim-robot)")
    assert advice(["osqp", "nowhere_known"]).endswith(" nowhere-known")  # no extra has that one
    assert advice(["nowhere_known"]) == "pip install nowhere-known"


def test_a_missing_module_is_named_with_its_purpose_and_what_works_without():
    with pytest.raises(ImportError, match="a test needs nowhere_known, which is not installed"):
        optional("nowhere_known.part", purpose="a test")
    with pytest.raises(ImportError, match=r"pip install nowhere-known; or use another$"):
        optional("nowhere_known", purpose="a test", otherwise="use another")


def test_a_module_that_fails_to_import_is_told_from_a_missing_one(tmp_path, monkeypatch):
    (tmp_path / "broken_inside.py").write_text("import nowhere_known\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"which does not import .*nowhere_known"):
        optional("broken_inside", purpose="a test")


def test_all_that_is_missing_is_said_at_once_and_nothing_is_imported(monkeypatch):
    monkeypatch.setattr(home, "present", lambda name: name == "numpy")
    with pytest.raises(ImportError, match="the page needs plotly and jinja2, which are not"):
        ask_for(["numpy", "plotly", "jinja2"], purpose="the page")
    ask_for(["numpy"], purpose="the page")


def test_no_error_advises_the_distribution_of_diffsim_itself():
    """It lies on no index, and a package of that name might be somebody else's."""
    from pathlib import Path

    import diffsim

    texts = Path(diffsim.__file__).parent.rglob("*.py")
    told = [p.name for p in texts if re.search(r"diffsim-robot\[", p.read_text("utf-8"))]
    assert told == []


def test_the_demo_says_what_it_lacks_before_it_computes(monkeypatch, tmp_path, capsys):
    from diffsim.cli.main import main

    monkeypatch.setattr(home, "present", lambda name: name != "matplotlib")
    assert main(["demo", "--quick", "--out", str(tmp_path / "out")]) == 2
    assert "the page of the demo needs matplotlib, which is not installed: pip install" in (
        capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()
