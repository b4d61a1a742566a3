"""Training scripts start from the task's recipe; what is given on the line goes first."""

from dataclasses import replace

import pytest

pytest.importorskip("gymnasium", reason="learning needs the extra 'rl'")

from diffsim.learn.gradient import GradientLearner, GradientOptions
from rl.arguments import (
    add_options,
    options_from,
    setup_from,
    start_from_recipe,
    training_parser,
)


def parsed(*words: str, by_gradient: bool = True):
    parser = training_parser("")
    add_options(parser, GradientOptions, "method")
    args = start_from_recipe(parser, words, by_gradient=by_gradient)
    return setup_from(args), options_from(GradientOptions, args)


def test_the_recipe_is_the_default() -> None:
    setup, options = parsed("--task", "SharkSwim", "--task-options", '{"robot": {"coarse": true}}')
    assert setup.task_options == {"clock": (0.5, 1.0), "robot": {"coarse": True}}
    assert (setup.output_gain, setup.balance_clock, setup.steps) == (0.5, True, 1200)
    assert (options.batch, options.learning_rate) == (1, 3e-3)


def test_the_jumper_has_whole_episodes_and_a_clock_of_its_stride() -> None:
    setup, options = parsed("--task", "SoftJumper")
    assert setup.task_options == {"clock": (1.5, 3.0)}
    assert (setup.output_gain, setup.balance_clock, setup.steps) == (0.5, True, 60_000)
    assert (options.batch, options.horizon, options.cut_every) == (1, 0, 60)
    assert setup.make_task().dt * 20 == pytest.approx(1.0 / max(setup.task_options["clock"]))


def test_what_is_given_goes_first() -> None:
    setup, options = parsed(
        "--task",
        "SharkSwim",
        "--task-options",
        '{"clock": []}',
        "--batch",
        "4",
        "--no-balance-clock",
        "--output-gain",
        "0.1",
        "--steps",
        "99",
    )
    assert setup.task_options == {"clock": []}
    assert (setup.output_gain, setup.balance_clock, setup.steps) == (0.1, False, 99)
    assert (options.batch, options.learning_rate) == (4, 3e-3)


def test_other_methods_get_the_clock_but_not_the_budget() -> None:
    setup, options = parsed("--task", "SharkSwim", by_gradient=False)
    assert setup.task_options == {"clock": (0.5, 1.0)}
    assert (setup.output_gain, setup.steps) == (0.5, 200_000)
    assert options == GradientOptions()


def test_plain_runs_and_tasks_without_a_recipe() -> None:
    for words in (("--task", "SharkSwim", "--plain"), ("--task", "CowWalk")):
        setup, options = parsed(*words)
        assert (setup.task_options, setup.output_gain, setup.steps) == ({}, 0.01, 200_000)
        assert options == GradientOptions()


def test_a_copter_s_episodes_grow_over_the_budget() -> None:
    setup, options = parsed("--task", "CopterTrack")
    assert (options.batch, options.first_horizon, options.horizon) == (64, 30, 100)
    few = GradientLearner(setup, replace(options, batch=2))
    lengths = [few.update(progress).steps / 2 for progress in (0.0, 0.5, 1.0)]
    assert lengths == [30, 65, 100]
