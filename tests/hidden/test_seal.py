"""Nothing in the data folder gives the label away, and no label can be changed afterwards."""

from __future__ import annotations

import json

import numpy as np
import pytest

from diffsim.data import load_study
from diffsim.data.labs import LABS
from tests.hidden.seal import KINDS, draw_label, open_label, seal


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    root = tmp_path_factory.mktemp("sealed")
    label = {"system": "stokes", "kind": "single", "effects": {"leak": [2.1e-11]}, "decoys": []}
    label["seed"] = 1234567
    seal(label, root / "data", root / "vault", "case_000")
    return root / "data", root / "vault", label


def test_the_data_folder_does_not_name_the_cause(sealed):
    data, _, label = sealed
    content = "".join(p.read_text() for p in (data / "case_000").iterdir())
    assert "leak" not in content
    assert str(label["seed"]) not in content
    assert "truth" not in content
    assert load_study(data / "case_000").name == "case_000"


def test_the_label_opens(sealed):
    data, vault, label = sealed
    opened = open_label(data, vault, "case_000")
    assert opened["label"] == label
    assert opened["truth"]["effects"] == {"leak": [2.1e-11]}


def test_a_changed_label_is_noticed(sealed, tmp_path):
    data, vault, _ = sealed
    stored = json.loads((vault / "case_000.json").read_text())
    stored["sealed"] = stored["sealed"].replace("leak", "slip")
    (tmp_path / "case_000.json").write_text(json.dumps(stored))
    with pytest.raises(ValueError, match="not the one that was sealed"):
        open_label(data, tmp_path, "case_000")


def test_vault_inside_the_data_is_refused(tmp_path):
    label = draw_label(np.random.default_rng(0), ["stokes"])
    with pytest.raises(ValueError, match="outside the data folder"):
        seal(label, tmp_path, tmp_path / "vault", "case_000")
    assert not list(tmp_path.iterdir())


def test_labels_cover_all_kinds_and_sizes_within_range():
    rng = np.random.default_rng(1)
    labels = [draw_label(rng) for _ in range(400)]
    assert {label["kind"] for label in labels} == set(KINDS)
    for label in labels:
        known = LABS[label["system"]].effects
        assert len(label["effects"]) == {"null": 0, "decoy": 0, "pair": 2}.get(label["kind"], 1)
        assert bool(label["decoys"]) == (label["kind"] == "decoy")
        for name, size in label["effects"].items():
            assert known[name].outside == (label["kind"] == "outside")
            assert 0.3 <= np.linalg.norm(size) / known[name].typical <= 2.0 + 1e-9
