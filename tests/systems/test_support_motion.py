"""A support that moves: against beam theory, and found where it was hidden."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.diagnose import diagnose
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Jacobian, Problem, SearchSettings, WhiteNoise
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.linearization import linearization_at
from diffsim.systems.registry import description_of
from tests.systems.soft_body.bars import released_bar
from tests.systems.soft_body.causes import CAUSES
from tests.systems.swaying_lab import GRAVITY, HELD_START, SHIFT, TURN, beam_matrices, recorded


def model_of(study, cells=(4, 2, 2)):
    """Held at its tip until the first sample, at a height that nobody knows."""
    zero = {"value": 0.0, "sd": 1e-3, "per": "run"}
    body = released_bar(cells=cells, dt_s=5e-3, integrator="implicit_midpoint", gravity=GRAVITY) | {
        "channels": {"tip_z_m": {"markers": ["tip1", "tip2", "tip3"], "axis": "z", "zero": zero}},
        "start": HELD_START,
    }
    body["numerics"] |= {"correct_mesh": True}
    return description_of(replace(study, model=body)).setup(study).model


def fitted(study, *effects):
    noise = WhiteNoise(study.channels)
    problem = Problem(model_of(study), study.fit_runs, noise, effects, Jacobian())
    return gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))[0]


def test_a_beam_of_the_laboratory_is_a_cantilever():
    """Its sag against Timoshenko's formula."""
    mass, stiff = beam_matrices()
    load = np.zeros(len(mass))
    load[-2] = 1.0
    area, inertia, young = 9e-4, 0.03**4 / 12.0, 2.3e5
    shear = 10.0 * 1.45 / (12.0 + 11.0 * 0.45) * young / 2.9
    expected = 1e-3 / (3.0 * young * inertia) + 0.1 / (shear * area)
    assert np.linalg.solve(stiff, load)[-2] == pytest.approx(expected, rel=1e-6)


@pytest.mark.story  # two fits of whole swings
def test_sizes_are_those_that_were_hidden():
    """What the clamp's record shows explains the swing, with the shift and turn that it has."""
    study = recorded()
    plain, moved = fitted(study), fitted(study, CAUSES["support_motion"])
    assert plain.chi2 > 10.0 * plain.num_samples
    assert moved.chi2 < 2.0 * moved.num_samples
    shift, turn = (moved.values[f"support_motion.{n}"] for n in ("shift", "turn"))
    assert shift == pytest.approx(SHIFT, abs=0.15)
    assert turn == pytest.approx(TURN, abs=0.06)


def test_a_support_at_rest_is_left_alone():
    study = recorded()
    model = model_of(study)
    still = {n: np.full_like(v, 1e-3) for n, v in study.runs[0].command.items()}
    run = replace(study.runs[0], command=still)
    scene = model.scene(run, model.at_prior())
    assert CAUSES["support_motion"].apply(scene, model.at_prior()[:2] + 1.0, run) is scene


@pytest.mark.slow
def test_it_is_named_where_it_was_hidden():
    """Among other causes of damping and drift, by a diagnosis that sees recordings only."""
    study = recorded()
    named = ("loss_factor", "creep", "linear_drag", "support_motion")
    causes = tuple(CAUSES[name] for name in named)
    found = diagnose(
        study,
        model_of(study, (8, 3, 3)),
        causes,
        seed=0,
        settings=DiagnosisSettings(
            search=SearchSettings(max_effects=2, num_refits=2, max_rounds=3)
        ),
    )
    assert found.verdict == "named" and found.named == ("support_motion",)
    assert found.gain.status == "confirmed" and found.gain.value > 0.8
