"""Blind diagnosis: scoring rules, resuming, and the whole procedure on the toy."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffsim.core import open_executor
from diffsim.identify.model import Numerics, SimModel
from labs.blind import __main__ as command
from labs.blind import case
from labs.blind import sessions as blind_module
from labs.blind.case import CoarseModel, twin
from labs.blind.score import score_answer, true_sizes, with_strength
from labs.blind.sealed import BENCHES, seal
from labs.blind.sessions import Blind
from labs.blind.strength import score_simulated
from labs.blind.table import by_strength, confusion, figures, markdown
from tests.diagnose import toy, toy_setup
from tests.labs.blind.toy_lab import TOY

SETUP = Path(toy_setup.__file__)
QUICK_SEED = 11  # fixed: the quick set must give the same cases every time


def label(kind, effects=None, **more):
    return {"kind": kind, "effects": effects or {}, "decoys": [], "options": {}, **more}


def answer(verdict, named=(), rivals=(), **more):
    sets = {"named": list(named), "rivals": list(rivals)}
    return {"verdict": verdict, **sets, "intervals": {}, **more}


@pytest.mark.parametrize(
    ("hidden", "given", "right"),
    [
        (label("null"), answer("none"), True),
        (label("null"), answer("named", ["drag"]), False),
        (label("null"), answer("unknown"), False),
        (label("decoy", decoys=["spikes"]), answer("none"), True),
        (label("decoy", decoys=["scatter"]), answer("none"), False),
        (label("decoy", decoys=["scatter"]), answer("unrepeatable"), True),
        (label("single", {"drag": [0.1]}), answer("named", ["drag"]), True),
        (label("single", {"drag": [0.1]}), answer("ambiguous", ["lag"], [["drag"]]), True),
        (label("single", {"drag": [0.1]}), answer("named", ["drag", "lag"]), False),
        (label("single", {"drag": [0.1]}), answer("unknown", ["drag"]), False),
        (label("pair", {"drag": [0.1], "lag": [0.1]}), answer("named", ["drag", "lag"]), True),
        (label("pair", {"drag": [0.1], "lag": [0.1]}), answer("named", ["drag"]), False),
        (label("outside", {"pulse": [0.1]}), answer("unknown"), True),
        (label("outside", {"pulse": [0.1]}), answer("named", ["drag"]), False),
        # what this library lacks is outside, whatever the laboratory calls it
        (label("single", {"pulse": [0.1]}), answer("unknown"), True),
        (label("look_alike", {"delay": [0.1]}), answer("named", ["lag"]), True),
        (label("look_alike", {"delay": [0.1]}), answer("unknown"), True),
        (label("look_alike", {"delay": [0.1]}), answer("named", ["lag", "drag"]), False),
        (label("look_alike", {"delay": [0.1]}), answer("none"), False),
        (label("twins", {"lag": [0.1]}), answer("ambiguous", ["lag"], [["lag_again"]]), True),
        (label("twins", {"lag": [0.1]}), answer("ambiguous", ["lag"], [["delay"]]), False),
        (label("twins", {"lag": [0.1]}), answer("named", ["lag"]), False),
        (label("invisible", {"scale": [0.1]}), answer("none", cannot_see={"scale": ""}), True),
        (label("invisible", {"scale": [0.1]}), answer("none", cannot_see={}), False),
        (label("numerical"), answer("numerical"), True),
        (label("numerical"), answer("none"), False),
        (label("single", {"drag": [0.1]}), {"verdict": "failed", "error": "x"}, False),
    ],
)
def test_what_counts_as_right(hidden, given, right):
    assert score_answer(hidden, given, toy.LIBRARY)["right"] is right


def test_a_class_counts_as_given_only_whole():
    hidden = label("confounded", {"lag": [0.1]}, **{"class": ["lag", "delay"]})
    whole = answer("ambiguous", ["delay"], [["lag"]])
    assert score_answer(hidden, whole, toy.LIBRARY)["class_given"]
    alone = score_answer(hidden, answer("named", ["lag"]), toy.LIBRARY)
    assert alone["right"] and not alone["class_given"]


def test_places_of_a_laboratory_are_effects_of_a_library():
    known = {name: toy.DRAG for name in ("weak_rotor_1", "weak_rotor_2", "drag")}
    hidden = label("single", {"weak_rotor": [0.0, 0.1]})
    assert true_sizes(hidden, known) == {"weak_rotor_2": (0.1,)}
    assert true_sizes(label("single", {"drag": [0.2]}), known) == {"drag": (0.2,)}
    assert true_sizes(label("single", {"stop": [0.2]}), known) == {"stop": None}


def test_size_is_held_against_the_interval_that_was_reported():
    given = answer("named", ["drag"], intervals={"drag": {"size": [0.12, 0.11, 0.15]}})
    inside = score_answer(label("single", {"drag": [0.145]}), given, toy.LIBRARY)
    assert inside["sizes"]["drag"]["inside"]
    below = score_answer(label("single", {"drag": [0.105]}), given, toy.LIBRARY)
    assert not below["sizes"]["drag"]["inside"]


def test_figures_count_by_hand():
    scores = []
    for i, strength in enumerate((20.0, 9.0, 6.0, 2.0)):
        right = i != 1
        given = answer("named", ["drag"] if right else ["lag"])
        score = score_answer(label("single", {"drag": [0.1]}), given, toy.LIBRARY)
        scores.append({"case": f"c{i}", **score, "lambda": {"drag": strength}})
    scores.append({"case": "n", **score_answer(label("null"), answer("unknown"), toy.LIBRARY)})
    found = {row["what"]: row for row in figures(scores)}
    assert found["one effect, lambda >= 8: right, alone or in the set"]["value"] == 0.5
    assert found["one effect, lambda 5 to 8: right, alone or in the set"]["value"] == 1.0
    assert found["name given alone, wrong"]["hits"] == 1
    assert found["nulls and decoys with a name or unknown"]["value"] == 1.0
    assert confusion(scores)["single"]["named"] == 4
    rows = [(r["what"], r["n"], r["hits"], r["wrong_alone"]) for r in by_strength(scores)]
    assert rows == [("below 3", 1, 1, 0), ("3 to 8", 1, 1, 0), ("8 or more", 2, 1, 1)]
    page = markdown(scores, title="t", command="c")
    assert "| c1 | single:, drag | 9.0 | named lag  |" in page and "c0 |" not in page


def test_twins_predict_the_same_and_coarse_models_are_coarser():
    run = toy.generate(0).runs[0]
    model = toy.model([run], implicit_step=0.01)
    q = model.at_prior()
    delay = toy.DELAY
    again = twin(delay)
    assert again.name == "delay_again" and again.family == delay.family
    size = q.new_tensor([0.02])
    np.testing.assert_array_equal(
        model.predict(run, q, {delay: size}), model.predict(run, q, {again: size})
    )
    rough = CoarseModel(model, {"time_step": 2.0})
    expected = SimModel.predict(model, run, q, None, Numerics(time_step=2.0))
    np.testing.assert_array_equal(rough.predict(run, q), expected)
    half = rough.predict(run, q, None, Numerics(time_step=0.5))
    np.testing.assert_array_equal(half, model.predict(run, q))


def test_lambda_counts_misfit_and_the_pull_on_data_sheets(tmp_path):
    """Places of the runs take up a part of the bias, which their priors resist."""
    found = {}
    for size in (0.0, 0.1, 0.2):
        hidden = label("single", {"bias": [size]}, seed=5)
        folder = seal(TOY, hidden, tmp_path / f"data_{size}", tmp_path / "vault", "case")
        scored = {"truth": {"bias": (size,)}, "gain": None}
        found[size] = score_simulated(TOY, hidden, folder, scored, SETUP)
    strength = [f["lambda"]["bias"] for f in found.values()]
    assert strength[0] == 0.0
    assert strength[2] == pytest.approx(2.0 * strength[1], rel=0.05)
    assert strength[1] > 1.05 * found[0.1]["misfit"]["bias"]


def answered_here(command, folder, environment, timeout_s):
    """What the process of a case would do, without starting one."""
    assert command[1:3] == ["-m", "labs.blind.case"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        case.main(command[3:])
    return 0, ""


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Two cases, the first diagnosed in a process of its own."""
    root = tmp_path_factory.mktemp("blind")
    blind = Blind(
        TOY, "toy", QUICK_SEED, root / "out", root / "vault", ("null", "single"),
        quick=True, setup_file=SETUP,
    )  # fmt: skip
    blind.run(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blind_module, "_ended", answered_here)
        return blind, blind.run(2)


@pytest.mark.cpu(8)  # the process imports everything anew
def test_cases_are_diagnosed_in_their_own_process_and_scored(solved):
    blind, scores = solved
    assert all(s["verdict"] != "failed" for s in scores), scores
    assert all(s["cpu_s"] > 0.0 for s in scores)
    hidden = [s for s in scores if s["truth"]]
    assert all(s["lambda"].keys() == s["truth"].keys() for s in hidden)
    page = (blind.out / "confusion.md").read_text()
    assert page.startswith("# Sealed cases of the toy") and f"--seed {QUICK_SEED}" in page


@pytest.mark.slow
def test_an_executor_changes_nothing(solved, tmp_path):
    blind, scores = solved
    other = replace(blind, out=tmp_path / "out", vault=tmp_path / "vault")
    with open_executor("processes:2") as workers:
        found = other.run(2, workers)
    timed = ("cpu_s", "wall_s")
    assert [{k: v for k, v in s.items() if k not in timed} for s in found] == [
        {k: v for k, v in s.items() if k not in timed} for s in scores
    ]


@pytest.mark.parametrize("name", sorted(BENCHES))
def test_every_bench_can_be_sent_to_a_worker(name):
    assert pickle.loads(pickle.dumps(BENCHES[name])) is not None


def test_answers_and_scores_are_kept(solved, monkeypatch):
    blind, scores = solved
    monkeypatch.setattr(Blind, "_run", lambda *_: pytest.fail("the case was diagnosed again"))
    assert blind.run(2) == scores


def test_sets_are_counted_together(solved, capsys, tmp_path):
    blind, scores = solved
    assert command.main(["--tables", str(blind.out), str(blind.out)]) == 0
    counted = confusion([*scores, *scores])
    printed = capsys.readouterr().out
    for kind, row in counted.items():
        assert f"| {kind} | {row['n']} | {row['right']} |" in printed
    assert command.main(["--tables", str(tmp_path)]) == 2
    assert "holds no scores" in capsys.readouterr().err


def test_an_exchanged_label_stops_the_scoring(solved, tmp_path):
    blind, _ = solved
    for path in blind.vault.glob("case_*.json"):
        stored = json.loads(path.read_text())
        stored["salt"] = "0" * 64
        (tmp_path / path.name).write_text(json.dumps(stored))
    other = Blind(TOY, "toy", QUICK_SEED, blind.out, tmp_path, blind.kinds, True)
    with pytest.raises(ValueError, match="not the one that was sealed"):
        other.score("case_000")


def test_the_process_gets_the_data_and_a_bare_environment(solved, monkeypatch, tmp_path):
    blind, _ = solved
    monkeypatch.setenv("SECRET_LABEL", "drag")
    seen = {}

    def spy(command, folder, environment, timeout_s):
        seen.update(command=command, environment=environment, files=sorted(Path(folder).iterdir()))
        return 1, "stop here"

    monkeypatch.setattr(blind_module, "_ended", spy)
    (blind.out / "answers" / "case_000.json").rename(tmp_path / "kept.json")
    try:
        given = blind.answer("case_000")
    finally:
        (tmp_path / "kept.json").rename(blind.out / "answers" / "case_000.json")
    assert given == {"verdict": "failed", "error": "status 1: stop here", "timeout_s": 3600.0}
    assert "SECRET_LABEL" not in seen["environment"]
    assert not any(str(blind.vault) in word for word in seen["command"])
    assert {p.name for p in seen["files"]} >= {"study.yaml", "options.json", "label.sha256"}


def test_a_case_that_ran_out_of_time_is_asked_again_with_more(tmp_path, monkeypatch):
    asked = []

    def late(self, folder, result):
        asked.append(self.timeout_s)
        return f"no answer within {self.timeout_s:g} s"

    monkeypatch.setattr(Blind, "_run", late)
    for timeout_s in (10.0, 10.0, 20.0, 5.0):
        blind = Blind(
            TOY, "toy", QUICK_SEED, tmp_path / "out", tmp_path / "vault", ("null",), True,
            timeout_s, SETUP,
        )  # fmt: skip
        (score,) = blind.run(1)
        assert score["verdict"] == "failed" and not score["right"]
    assert asked == [10.0, 20.0]


def test_what_the_base_parameters_absorb_is_rightly_not_found():
    hidden = label("single", {"pulse": [0.1]})  # not in the library
    none = score_answer(hidden, answer("none"), toy.LIBRARY)
    assert not with_strength({**none, "lambda": {"pulse": 12.0}})["right"]
    absorbed = with_strength({**none, "lambda": {"pulse": 0.4}})
    assert absorbed["right"] and absorbed["scored_as"] == "absorbed"
    blamed = score_answer(hidden, answer("unknown"), toy.LIBRARY)
    assert not with_strength({**blamed, "lambda": {"pulse": 0.4}})["right"]


def test_another_set_in_the_same_folder_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Blind, "run", lambda *_: [])
    argv = ["--system", "network", "--out", str(tmp_path / "o")]
    assert command.main([*argv, "--seed", "4", "--n", "2"]) == 0
    assert "seed 4;" in capsys.readouterr().out
    assert command.main([*argv, "--n", "3"]) == 0  # goes on with the seed it finds
    assert "seed 4;" in capsys.readouterr().out
    assert command.main([*argv, "--seed", "5"]) == 2
    assert "holds other cases" in capsys.readouterr().err


def test_a_fresh_seed_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Blind, "run", lambda *_: [])
    monkeypatch.setattr(blind_module.secrets, "randbits", lambda _: 123456)
    assert command.main(["--out", str(tmp_path / "o")]) == 0
    assert "seed 123456;" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["decoy", "outside", "look_alike", "confounded", "twins", "invisible", "pair"]
)
def test_every_kind_runs_on_the_toy(kind, tmp_path):
    blind = Blind(
        TOY, "toy", QUICK_SEED, tmp_path / "out", tmp_path / "vault", (kind,), setup_file=SETUP
    )
    (score,) = blind.run(1)
    assert score["verdict"] != "failed", score["error"]
