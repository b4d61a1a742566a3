"""Summing up runs, gradient quality, and the comparison from end to end."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need gymnasium: pip install '.[rl]'")

from diffsim.core import open_executor
from diffsim.envs.registry import make_task
from diffsim.learn import METHODS
from diffsim.learn.gradient import BadGradients
from diffsim.learn.setup import Setup, first_controller
from rl import compare, comparison, presets, trainings
from rl.quality import gradient_quality
from rl.reward_statistics import (
    Scale,
    bootstrap_interval,
    first_reach,
    held,
    interquartile_mean,
)
from rl.trainings import Plan, train_once, tune
from tests.optional import needs

needs("stable_baselines3", reason="PPO is stable-baselines3's: pip install '.[rl]'")
needs("tensorboard", reason="training writes a TensorBoard log")
needs("matplotlib", reason="the comparison draws a figure")
needs("cma", reason="CMA-ES is the package cma: pip install '.[rl]'")


def rows(rewards: list[float]) -> list[comparison.Row]:
    """Ratings every 10 steps."""
    return [
        {
            "steps": 10 * k,
            "seconds": 1.0 * k,
            "forward_equivalents": 40.0 * k,
            "reward": r,
            "finished": k == len(rewards) - 1,
        }
        for k, r in enumerate(rewards)
    ]


def test_interquartile_mean_drops_a_quarter_at_each_end() -> None:
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0, -100.0])) == pytest.approx(2.0)
    values = np.random.default_rng(0).standard_normal((8, 3))
    want = np.sort(values, axis=0)[2:6].mean(0)
    np.testing.assert_allclose(interquartile_mean(values), want)


def test_bootstrap_interval_agrees_with_one_resampled_by_hand() -> None:
    values = np.random.default_rng(1).standard_normal(12)
    low, high = bootstrap_interval(values, resamples=20_000)
    rng = np.random.default_rng(2)
    drawn = values[rng.integers(0, 12, (20_000, 12))]
    want = np.quantile(np.sort(drawn, axis=1)[:, 3:9].mean(1), [0.025, 0.975])
    np.testing.assert_allclose([low, high], want, atol=0.03)
    assert bootstrap_interval(values[:1]) == (values[0], values[0])


def test_rewards_hold_until_the_next_rating_and_breakdowns_count_as_nothing_learned() -> None:
    run = rows([0.1, 0.5, math.nan, 0.9])
    got = held(run, "steps", np.array([0.0, 9.0, 10.0, 25.0, 99.0]))
    np.testing.assert_allclose(got, [0.1, 0.1, 0.5, 0.1, 0.9])
    assert first_reach(run, "seconds", 0.6) == 3.0
    assert first_reach(run, "seconds", 1.0) == math.inf


def test_scale_has_untrained_networks_at_zero_and_needs_a_gain() -> None:
    assert Scale(2.0, 4.0)(3.0) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="gain something"):
        Scale(2.0, 1.0)(3.0)


def test_summary_keeps_runs_that_never_reach_the_goal() -> None:
    runs = {
        "gradient": {0: rows([0.0, 1.0]), 1: rows([0.0, 1.0]), 2: rows([0.0, 0.5, 1.0])},
        "ppo": {0: rows([0.0, 0.1]), 1: rows([0.0, 0.95]), 2: rows([0.0, 0.2])},
    }
    gradient, ppo = comparison.summarize(runs, Scale(0.0, 1.0))
    assert gradient["reached"] == 3 and gradient["steps_to_goal"] == 10.0
    assert ppo["reached"] == 1 and ppo["steps_to_goal"] == math.inf
    # PPO ends at 0.1, 0.95 and 0.2, the gradient is better at its first rating
    assert ppo["gradient_steps_to_final"] == 10.0
    assert comparison.summarize({"ppo": runs["ppo"]}, Scale(0.0, 1.0))[0]["reached"] == 1
    assert "| - | - | - |" in comparison.table("X", [ppo])


def test_gradients_of_a_short_flight_agree_with_sampled_ones() -> None:
    task = make_task("CopterHover", seconds=0.4)
    controller = first_controller(task, 0, 10)
    rows = gradient_quality(task, controller, [5, 10], episodes=3, directions=16, spread=1e-3)
    for row in rows:
        assert row["cosine"] > 0.999
        assert row["norm_ratio"] == pytest.approx(1.0, abs=0.02)
        assert row["explosion_rate"] == 0.0 and row["contact_share"] == 0.0


def test_gradient_quality_differentiates_the_mean_over_episodes() -> None:
    # its per-episode gradients, by members' own weights, average to the plain gradient
    task = make_task("CopterHover", seconds=0.2)
    controller = first_controller(task, 0, 10)
    from diffsim.envs.rollout import rollout_task
    from rl.quality import _per_episode

    weights = {k: p.detach() for k, p in controller.named_parameters()}
    each = _per_episode(task, controller, weights, 5, 3, 0)
    start = task.start(3, np.random.default_rng(0))
    loss = rollout_task(task, controller, start, 5).rewards.mean()
    plain = torch.autograd.grad(loss, list(controller.parameters()))
    torch.testing.assert_close(each.mean(0), torch.cat([g.flatten() for g in plain]))


def tiny_plan() -> Plan:
    setup = Setup("CopterHover", {"seconds": 0.2}, evaluation_episodes=2, warm_up=5)
    candidates = {"gradient": ({"batch": 4}, {"batch": 4, "learning_rate": 1e-2})}
    return Plan(setup, {"gradient": 160}, {"gradient": 80}, candidates, seeds=(0,), ratings=2)


def test_the_search_is_recorded_and_nothing_runs_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = tune(tiny_plan(), "gradient", tmp_path, show=False)
    record = json.loads((tmp_path / "tuning_gradient.json").read_text())
    assert record["candidates"][record["best"]]["options"] == best
    assert [c["steps"] for c in record["candidates"]] == [80, 80]
    monkeypatch.setattr(trainings, "train", lambda *a, **k: pytest.fail("ran again"))
    assert tune(tiny_plan(), "gradient", tmp_path, show=False) == best
    shutil.rmtree(tmp_path / "tuning")  # the record stands in for its runs, of these options only
    assert tune(tiny_plan(), "gradient", tmp_path, show=False) == best
    for change in (
        {"candidates": {"gradient": ({"batch": 4}, {"batch": 2})}},
        {"tuning_steps": {"gradient": 160}},
    ):
        with pytest.raises(pytest.fail.Exception, match="ran again"):
            tune(dataclasses.replace(tiny_plan(), **change), "gradient", tmp_path, show=False)


def test_a_run_that_dies_is_a_result(tmp_path: Path) -> None:
    def dead(*args: object, **options: object) -> None:
        raise BadGradients("3 updates")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainings, "train", dead)
        setup = tiny_plan().run_setup("gradient", 0)
        assert train_once(setup, "gradient", {"batch": 4}, tmp_path) == "BadGradients: 3 updates"
    assert train_once(setup, "gradient", {"batch": 4}, tmp_path) == "BadGradients: 3 updates"


def test_a_mistake_is_not_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def mistaken(*args: object, **options: object) -> None:
        raise RuntimeError("shapes cannot be multiplied")

    monkeypatch.setattr(trainings, "train", mistaken)
    with pytest.raises(RuntimeError, match="shapes"):
        train_once(tiny_plan().run_setup("gradient", 0), "gradient", {"batch": 4}, tmp_path)
    assert not (tmp_path / "failure.txt").exists()


def test_every_method_may_try_equally_many_candidates() -> None:
    for name in presets.PRESETS:
        for plan in presets.preset(name).values():
            tries = {method: len(c) for method, c in plan.candidates.items()}
            mine = tries.pop("gradient")
            assert len(set(tries.values())) == 1 and mine <= min(tries.values())
            # by the recipe the gradient has nothing to choose
            assert mine == (1 if name.endswith("recipe") else tries["ppo"])
            assert set(plan.steps) == set(plan.tuning_steps) == set(plan.candidates) <= set(METHODS)
            assert name == "quick" or len(plan.seeds) >= 5


@pytest.mark.parametrize(
    "chosen",
    [
        pytest.param(
            ("gradient", "ppo"),
            marks=pytest.mark.short_of(
                "test_the_quick_comparison_runs_and_reports_again_without_training[all]"
            ),
        ),
        pytest.param(tuple(METHODS), marks=pytest.mark.slow),
    ],
    ids=["two", "all"],
)
def test_the_quick_comparison_runs_and_reports_again_without_training(
    chosen: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shorter = {
        task: Plan(
            p.setup,
            {m: 320 for m in p.steps if m in chosen},
            {},
            {m: c[:1] for m, c in p.candidates.items() if m in chosen},
            seeds=(0, 1),
        )
        for task, p in presets.preset("quick").items()
    }
    monkeypatch.setattr(compare, "preset", lambda name: shorter)
    # so short a training gains nothing reliably: any unit will do
    monkeypatch.setattr(comparison, "scale_of", lambda *a: Scale(0.0, 1.0))
    compare.main(["--out", str(tmp_path)])
    folder = tmp_path / "quick" / "CopterHover"
    assert (folder / "learning_CopterHover.png").stat().st_size > 10_000
    first = capsys.readouterr().out
    assert "| ppo |" in first and "cosine" in first
    monkeypatch.setattr(trainings, "train", lambda *a, **k: pytest.fail("ran again"))
    compare.main(["--out", str(tmp_path)])
    assert capsys.readouterr().out == first


def test_runs_in_progress_are_not_summed_up_but_failed_ones_are(tmp_path: Path) -> None:
    going = [r | {"finished": False, "gradient_steps": r["steps"]} for r in rows([0.0, 0.5])]
    for seed, name in enumerate(("progress", "failed", "finished")):
        folder = tmp_path / "gradient" / f"seed_{seed}"
        folder.mkdir(parents=True)
        last = going[-1] | {"finished": name == "finished"}
        lines = [json.dumps(r) for r in (going[0], last)]
        (folder / "results.jsonl").write_text("\n".join(lines) + "\n")
        if name == "failed":
            (folder / trainings.FAILURE).write_text("BadGradients: 10 updates")
    plan = tiny_plan()
    runs = comparison.collect(plan, tmp_path)
    assert sorted(runs["gradient"]) == [1, 2]
    assert runs["gradient"][1][-1]["forward_equivalents"] == 10 * plan.setup.step_cost
    (row,) = comparison.summarize(runs, Scale(0.0, 1.0))
    assert (row["runs"], row["finished"]) == (2, 1)
    assert "(1 failed)" in comparison.table("X", [row])

    alone = tmp_path / "record"
    alone.mkdir()
    comparison.keep_record(runs, alone)
    assert comparison.summarize(comparison.collect(plan, alone), Scale(0.0, 1.0)) == [row]

    # a method added later joins the record
    folder = alone / "ppo" / "seed_3"
    folder.mkdir(parents=True)
    later = [r | {"gradient_steps": 0} for r in rows([0.0, 0.2])]
    (folder / "results.jsonl").write_text("\n".join(json.dumps(r) for r in later) + "\n")
    both = comparison.collect(plan, alone)
    assert {m: sorted(r) for m, r in both.items()} == {"gradient": [1, 2], "ppo": [3]}
    assert both["gradient"] == runs["gradient"]


def test_an_executor_changes_nothing(tmp_path: Path) -> None:
    plan = dataclasses.replace(
        tiny_plan(),
        candidates={**tiny_plan().candidates, "sac": ({"passes": 2, "learning_rate": 1e-3},)},
        steps={"gradient": 160, "sac": 160},
    )
    ratings = {}
    for word in ("here", "processes:2"):
        folder = tmp_path / word.partition(":")[0]
        with open_executor(word) as executor:
            comparison.run_all(plan, folder, executor=executor, show=False)
        runs = comparison.collect(plan, folder)
        ratings[word] = {
            (method, seed): [(row["steps"], row["reward"]) for row in rows]
            for method, by_seed in runs.items()
            for seed, rows in by_seed.items()
        }
        ratings[word, "chosen"] = json.loads((folder / "tuning_gradient.json").read_text())["best"]
    assert len(ratings["here"]) == 2
    assert ratings["processes:2"] == ratings["here"]
    assert ratings["processes:2", "chosen"] == ratings["here", "chosen"]
