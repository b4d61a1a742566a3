"""Nothing in the data folder gives the label away, and no label can be changed afterwards."""

from __future__ import annotations

import json

import numpy as np
import pytest

from diffsim.data import load_study
from labs.blind.sealed import (
    BENCHES,
    KINDS,
    Blindfold,
    draw_label,
    is_sealed,
    open_label,
    seal,
    study_of,
)

NETWORK = BENCHES["network"]


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    root = tmp_path_factory.mktemp("sealed")
    label = {"kind": "single", "effects": {"leak": [2.1e-11]}, "decoys": [], "options": {}}
    label["seed"] = 1234567
    seal(NETWORK, label, root / "data", root / "vault", "case_000")
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
    assert is_sealed(data, vault, "case_000") and not is_sealed(data, vault, "case_001")


def test_a_changed_label_is_noticed(sealed, tmp_path):
    data, vault, _ = sealed
    stored = json.loads((vault / "case_000.json").read_text())
    stored["sealed"] = stored["sealed"].replace("leak", "slip")
    (tmp_path / "case_000.json").write_text(json.dumps(stored))
    with pytest.raises(ValueError, match="not the one that was sealed"):
        open_label(data, tmp_path, "case_000")


def test_vault_inside_the_data_is_refused(tmp_path):
    label = draw_label(np.random.default_rng(0), NETWORK)
    with pytest.raises(ValueError, match="outside the data folder"):
        seal(NETWORK, label, tmp_path, tmp_path / "vault", "case_000")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", BENCHES)
def test_labels_cover_all_kinds_and_sizes_within_range(name):
    bench = BENCHES[name]
    rng = np.random.default_rng(1)
    labels = [draw_label(rng, bench) for _ in range(400)]
    known = bench.lab().effects
    assert {label["kind"] for label in labels} == set(KINDS)
    for label in labels:
        kind = label["kind"]
        count = {"null": 0, "decoy": 0, "numerical": 0, "pair": 2}.get(kind, 1)
        assert len(label["effects"]) == count
        assert bool(label["decoys"]) == (kind == "decoy")
        for effect, size in label["effects"].items():
            assert known[effect].outside == (kind == "outside")
            low, high = bench.sizes
            assert low <= np.linalg.norm(size) / known[effect].typical <= high + 1e-9


@pytest.mark.parametrize("name", BENCHES)
def test_every_name_of_a_bench_is_one_of_its_laboratory(name):
    bench = BENCHES[name]
    lab = bench.lab()
    members = [n for names, _ in bench.confounded for n in names]
    for effect in (*members, *bench.look_alike, *(n for n, _ in bench.invisible)):
        assert effect in lab.effects
    folds = [fold for _, fold in (*bench.confounded, *bench.invisible)]
    channels = {c.name for c in lab.channels}
    plans = [plan.name for plan in lab.plans(np.random.default_rng(0)) if plan.use == "fit"]
    for fold in folds:
        assert set(fold.blank) <= channels
        left = [p for p in plans if not p.startswith(fold.without_runs or ("\0",))]
        assert len(left) >= 2 and all(
            any(p.startswith(w) for p in plans) for w in fold.without_runs
        )


def test_twins_are_two_so_that_the_pair_names_no_cause():
    rng = np.random.default_rng(2)
    labels = [draw_label(rng, NETWORK, ["twins"]) for _ in range(20)]
    for label in labels:
        (truth,) = label["effects"]
        assert len(set(label["options"]["twins"])) == 2 and truth in label["options"]["twins"]
    assert (
        len({label["options"]["twins"].index(next(iter(label["effects"]))) for label in labels})
        == 2
    )


def test_study_without_noise_differs_by_the_noise_only():
    label = {"effects": {"leak": [2.1e-11]}, "decoys": ["gaps"], "seed": 5, "options": {}}
    noisy, truth = study_of(NETWORK, label)
    clean, same = study_of(NETWORK, label, noise=0.0)
    assert str(truth) == str(same)
    for a, b in zip(noisy.runs, clean.runs, strict=True):
        np.testing.assert_array_equal(np.isnan(a.measured), np.isnan(b.measured))
        left = (a.measured - b.measured) / [c.sd for c in noisy.channels]
        assert 0.7 < np.nanstd(left) < 1.3
    exact, _ = study_of(NETWORK, {**label, "decoys": []}, noise=0.0)
    lab_only = NETWORK.lab().case(5, {"leak": 2.1e-11}, noise=0.0).study
    np.testing.assert_array_equal(exact.runs[0].measured, lab_only.runs[0].measured)


def test_blindfold_takes_channels_and_runs_for_fitting():
    study = NETWORK.lab()(3)
    blind = Blindfold(blank=("pump_Pa",), without_runs=("low", "mixed"))(study)
    assert [r.name for r in blind.runs] == [r.name for r in study.runs if r.group != "low"]
    idx = [c.name for c in study.channels].index("pump_Pa")
    assert all(np.isnan(r.measured[:, idx]).all() for r in blind.runs)
    assert all(np.isfinite(np.delete(r.measured, idx, 1)).all() for r in blind.runs)


def test_unknown_kinds_are_refused():
    with pytest.raises(ValueError, match="did you mean 'single'"):
        draw_label(np.random.default_rng(0), NETWORK, ["singel"])


@pytest.mark.parametrize(
    "name", ["network", *(pytest.param(n, marks=pytest.mark.slow) for n in ("beam", "copter"))]
)
def test_every_decoy_can_be_made(name):
    bench = BENCHES[name]
    for decoy in bench.decoys:
        study_of(bench, {"effects": {}, "decoys": [decoy], "seed": 3, "options": {}})
