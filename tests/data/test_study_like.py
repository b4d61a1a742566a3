"""``like:`` in a study, and where published recordings are looked for."""

import pytest

from diffsim.data import find_dataset
from diffsim.data.study_file import READY, joined, load_study, read_whole, ready_rigs
from diffsim.systems.registry import setup_of

STUDY = """
name: mine
like: base.yaml
channels: [{name: position, sd: 2 mm}]
model: {parameters: {k: 50 N/m, c: null}, rates: {v: -k*x/m}}
runs: [{name: b, file: a.csv}]
"""
BASE = """
name: base
model:
  system: ode
  states: {x: first_position, v: 0}
  parameters: {k: {value: 40 N/m, percent: 10}, c: {value: 1 N s/m, percent: 10}, m: 1 kg}
  rates: {x: v, v: -(k*x + c*v)/m}
  readings: {position: x}
channels: [{name: position, column: x_m, unit: m, sd: 0.001}]
runs: [{name: a, file: a.csv}]
"""


def test_what_a_study_states_goes_before_what_it_is_like():
    base = {"a": {"b": 1, "c": [1, 2]}, "rows": [{"name": "x", "u": 1}, {"name": "y"}]}
    own = {"a": {"c": [3]}, "rows": [{"name": "z"}, {"name": "x", "u": 2, "v": 3}], "a2": 0}
    assert joined(base, own) == {
        "a": {"b": 1, "c": [3]},
        "rows": [{"name": "x", "u": 2, "v": 3}, {"name": "y"}, {"name": "z"}],
        "a2": 0,
    }
    assert joined(base, {"a": None}) == {"rows": base["rows"]}
    assert joined({"rows": [1, 2]}, {"rows": [{"name": "x"}]}) == {"rows": [{"name": "x"}]}
    assert joined({"a": {"b": 1}}, {"a": 5}) == {"a": 5}


def test_a_study_that_is_like_another_one_is_read_whole(tmp_path):
    (tmp_path / "study.yaml").write_text(STUDY)
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "a.csv").write_text("time_s,x_m\n0,1\n0.1,0.9\n0.2,0.7\n")
    study = load_study(tmp_path)
    assert (study.name, [r.name for r in study.runs]) == ("mine", ["b"])
    assert [(c.name, c.sd) for c in study.channels] == [("position", 0.002)]
    assert "c" not in study.model["parameters"]
    base = setup_of(study).model.base
    assert "k" not in [p.name for p in base]  # known here, with a prior there


def test_a_name_that_is_neither_a_file_nor_ready_is_refused(tmp_path):
    (tmp_path / "study.yaml").write_text("like: position_serv\n")
    with pytest.raises(FileNotFoundError, match="did you mean 'position_servo'"):
        read_whole(tmp_path / "study.yaml")
    (tmp_path / "study.yaml").write_text("like: study.yaml\n")
    with pytest.raises(ValueError, match=r"leads back to study\.yaml"):
        read_whole(tmp_path / "study.yaml")


def test_every_ready_rig_states_a_system():
    assert ready_rigs() == ("position_servo",)
    for name in ready_rigs():
        assert read_whole(READY / f"{name}.yaml")["model"]["system"] == "ode"


def test_find_dataset_never_falls_back_when_asked(tmp_path, monkeypatch):
    (tmp_path / "silicone_beam").mkdir()
    (tmp_path / "silicone_beam" / "metadata.yaml").write_text("{}")
    assert find_dataset("silicone_beam", tmp_path) == tmp_path / "silicone_beam"
    assert find_dataset("silicone_beam", tmp_path / "silicone_beam") is not None
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path))
    assert find_dataset("silicone_beam") == tmp_path / "silicone_beam"
    with pytest.raises(FileNotFoundError, match=r"silicone_beam; did you mean 'silicone_beam'"):
        find_dataset("silicon_beam")
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"DIFFSIM_DATA=.*nowhere .* does not exist"):
        find_dataset("silicone_beam")
