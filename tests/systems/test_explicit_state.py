"""What a model answers has the same bits whatever it was asked before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.identify import Problem
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of
from tests.systems.test_unseen_runs import MADE, study_of

SMALL = ("emps", "rotor_bench", "cube_toss", "soft_tentacle")  # published
NUM_EFFECTS = 3
POINTS = 3  # the prior, and two beside it


def problem_of(name):
    """Two runs of a study and some of its causes, by a model that was never asked for anything."""
    study = study_of(name)
    setup = setup_of(study)
    study = setup.study or study
    channels = [c if c.sd is not None else replace(c, sd=1.0) for c in study.channels]
    some = setup.effects[:: max(1, len(setup.effects) // NUM_EFFECTS)][:NUM_EFFECTS]
    return Problem(setup.model, study.runs[:2], WhiteNoise(channels), tuple(some))


def points_of(problem):
    """Standardized coordinates, (POINTS, n): sizes of causes are not negative."""
    rng = np.random.default_rng(0)
    away = 0.1 * rng.standard_normal((POINTS - 1, len(problem.names)))
    away[:, problem.num_base :] = np.abs(away[:, problem.num_base :])
    return np.vstack([np.zeros_like(away[:1]), away])


def questions_of(problem):
    """Functions of a problem by what they ask: predictions, slopes and batches, run by run."""
    points = points_of(problem)
    columns = [0, problem.num_base, len(problem.names) - 1]

    def ask(run, k):
        one = {"runs": (problem.runs[run],)}
        return {
            ("prediction", run, k): lambda p: replace(p, **one).residual(points[k]),
            ("slopes", run, k): lambda p: replace(p, **one).linearize(points[k], only=columns)[1],
            ("batch", run, k): lambda p: replace(p, **one).records(np.roll(points, k, axis=0)[:2]),
        }

    pairs = [(run, k) for run in range(len(problem.runs)) for k in range(POINTS)]
    return {key: function for pair in pairs for key, function in ask(*pair).items()}


def answers(problem, questions, seed):
    """Bytes of every answer, asked for in an order of its own."""
    order = np.random.default_rng(seed).permutation(len(questions))
    keys = [list(questions)[i] for i in order]
    with torch.no_grad():
        return {key: questions[key](problem).tobytes() for key in keys}


@pytest.mark.parametrize("name", [*MADE, *SMALL])
def test_answers_do_not_depend_on_what_was_asked_before(name):
    fresh, other = problem_of(name), problem_of(name)
    questions = questions_of(fresh)
    first = answers(fresh, questions, seed=1)
    assert len(set(first.values())) > len(first) // 2, "points that answer alike tell nothing"
    assert answers(other, questions, seed=2) == first
    assert answers(other, questions, seed=3) == first, "a model that was used answers otherwise"
