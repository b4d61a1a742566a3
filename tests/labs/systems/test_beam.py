"""The laboratory's beam as a solid, against the laboratory: shapes, frequency, causes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Run
from diffsim.diagnose import diagnose
from diffsim.identify import Numerics
from labs.systems import setup_of
from labs.virtual import SoftBeamLab
from labs.virtual.common import Plan
from labs.virtual.soft_beam import SD_M
from tests.labs.truths import exact

STILL = {"marker_place_m": np.zeros(2), "zero_seed": 0}
ORDER = 3  # of the run, for what drifts
OUT = {"stiffness_damping"}  # a base parameter
SAME = sorted(n for n, e in SoftBeamLab.effects.items() if not e.outside and n not in OUT)
# Rms of what is left at the true size over that of the change: stiffening by the body's mean strain
# instead of each place's, and friction that creeps where the laboratory's sticks, are other forms.
# A tension that passes a whole step within a sample is known by its mean there.
LEFT = {"stiffening": 0.45, "dry_friction": 0.2, "loss_factor": 0.25, "quantization": 0.3}


@pytest.fixture(scope="module")
def lab():
    return SoftBeamLab()


@pytest.fixture(scope="module")
def made(lab):
    rng = np.random.default_rng(0)
    runs = [
        Run(p.name, p.time_s, np.zeros((len(p.time_s), 2)), p.command, p.group, i, p.use)
        for i, p in enumerate(lab.plans(rng))
    ]
    return setup_of(lab._study(1, runs)), runs


def noise_free(lab, command, **effects):
    t = np.arange(len(command)) / 100.0
    truth = exact(lab, STILL, **effects) | {"order": ORDER}
    out, _ = lab.measure(Plan("r", "g", "fit", t, {"tendon_N": np.asarray(command)}), truth)
    return out - np.random.default_rng([0, ORDER]).normal(0.0, 0.1e-3, 2)


def predicted(made, command, effect=None, size=None):
    setup, runs = made
    t = np.arange(len(command)) / 100.0
    run = replace(
        runs[ORDER],
        time_s=t,
        measured=np.zeros((len(t), 2)),
        command={"tendon_N": np.array(command)},
    )
    cause = {e.name: e for e in setup.effects}
    sizes = {} if effect is None else {cause[effect]: torch.tensor(size, dtype=torch.float64)}
    with torch.no_grad():
        return setup.model.predict(run, setup.model.at_prior(), sizes).numpy()


def test_bends_as_the_laboratory_does_under_a_steady_pull(lab, made):
    shown, want = predicted(made, np.ones(8))[-1], noise_free(lab, np.ones(8))[-1]
    np.testing.assert_allclose(shown, want, rtol=3e-3)


def test_moves_as_the_laboratory_does(lab, made):
    """Two theories, same numbers, nothing fitted: within a third of the noise, rms."""
    plan = lab.plans(np.random.default_rng(0))[1]
    command = plan.command["tendon_N"]
    off = predicted(made, command) - noise_free(lab, command)
    assert np.sqrt(np.mean(off**2)) < 0.35 * SD_M


def test_refining_mesh_or_step_hardly_moves_the_record(lab, made):
    setup, runs = made
    run = replace(runs[1].part(slice(80)), measured=np.zeros((80, 2)))
    with torch.no_grad():
        plain, *fine = (
            setup.model.predict(run, setup.model.at_prior(), None, n)
            for n in (Numerics(), Numerics(mesh=0.5), Numerics(time_step=0.5))
        )
    for other in fine:
        assert 0.0 < float((other - plain).square().mean().sqrt()) < 0.25 * SD_M


@pytest.mark.slow
@pytest.mark.parametrize("name", SAME)
def test_cause_does_what_the_laboratory_does(lab, made, name):
    """Typical size of the laboratory in the library's term: the same change of the record."""
    size = SoftBeamLab.effects[name].typical
    t = np.arange(160) / 100.0
    command = 0.8 * (1.0 - np.cos(2 * np.pi * 1.9 * t))
    want = noise_free(lab, command, **{name: size}) - noise_free(lab, command)
    found = predicted(made, command, name, [size]) - predicted(made, command)
    left = np.linalg.norm(found - want) / np.linalg.norm(want)
    assert left < LEFT.get(name, 0.12)


def test_causes_and_runs_that_could_be_recorded(made):
    setup, runs = made
    names = {e.name for e in setup.effects}
    assert set(SAME) < names and len(names) == len(setup.effects)
    assert not {run.name for run in setup.bank} & {run.name for run in runs}
    with pytest.raises(ValueError, match="even number"):
        setup_of(SoftBeamLab()._study(1, runs), cells=[8, 3, 1]).model.scene(
            runs[0], setup.model.at_prior()
        )


def beginning(run):
    """The first 0.68 s."""
    command = {name: u[:68] for name, u in run.command.items()}
    return replace(run, time_s=run.time_s[:68], measured=run.measured[:68], command=command)


@pytest.mark.story  # a whole diagnosis
def test_few_runs_and_causes_end_to_end(lab):
    """A lag hidden by beam theory is named by the solid, with its size."""
    study = lab.case(7, {"lag": None}).study
    kept = [r for r in study.runs if r.name in ("release_a", "chirp_a", "two_tones")]
    study = replace(study, runs=tuple(beginning(r) for r in kept))
    s = setup_of(study)
    chosen = [e for e in s.effects if e.name in ("lag", "volume_drag", "tip_scale")]
    report = diagnose(study, s.model, chosen, seed=0, settings=s.settings)
    assert report.verdict == "named" and report.named == ("lag",)
    (row,) = (r for r in report.table if r.effect == "lag")
    assert abs(row.size["size"] - 0.006) < 3.0 * row.sd["size"] < 0.002
    assert report.gain.value > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [(), ("volume_drag",)])
def test_all_candidates_on_whole_recordings(lab, hidden):
    """Nothing hidden, and a drag."""
    study = lab.case(100 + len(hidden), dict.fromkeys(hidden)).study
    s = setup_of(study)
    report = diagnose(
        study, s.model, s.effects, seed=0, unknowns=s.unknowns, bank=s.bank, settings=s.settings
    )
    assert report.named == hidden, report.sentences
