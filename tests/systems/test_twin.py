"""A diagnosed system under new commands: values, gradients, draws, mended causes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.identify.extended import extended_model
from diffsim.identify.model_file import read_extended
from diffsim.sim_to_real import Tracking, best_command, worth
from diffsim.sim_to_real.tracking import Bounds
from diffsim.systems import Twin
from tests.systems.late_cart import MODEL, NEW, TASK, T, fitted_cart


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    return fitted_cart(tmp_path_factory.mktemp("twin"))


def test_says_of_a_recorded_command_what_the_fit_says(fitted):
    study, path, found = fitted
    twin, run = Twin.read(path, study, T), study.runs[1]
    seen = twin.simulate({"force": torch.from_numpy(run.command["force"])})
    assert twin.causes == tuple(e.name for e in found.problem.effects)
    model = extended_model(found)
    np.testing.assert_allclose(seen, model.predict(run, model.at_prior()), atol=1e-12)


@pytest.mark.grad
@pytest.mark.parametrize("held", [False, True])
def test_gradient_of_commands(fitted, held):
    study, path, _ = fitted
    model = {**MODEL, "inputs": [{"name": "force", "held": held}]}
    frame = {k: v for k, v in read_extended(path).frame.items() if k != "held"}
    saved = read_extended(path)
    object.__setattr__(saved, "frame", frame)
    twin = Twin.read(saved, study.__class__(**{**vars(study), "model": model}), NEW)
    force = torch.from_numpy(2.0 * np.sin(5.0 * NEW + 0.3)).requires_grad_()
    weights = torch.from_numpy(np.cos(9.0 * NEW))[:, None]
    (slope,) = torch.autograd.grad((weights * twin.simulate({"force": force})).sum(), force)
    way, h = torch.from_numpy(np.random.default_rng(1).standard_normal(len(NEW))), 1e-5
    with torch.no_grad():
        up, down = (
            (weights * twin.simulate({"force": force + s * h * way})).sum() for s in (1, -1)
        )
    assert float(slope @ way) == pytest.approx(float((up - down) / (2 * h)), rel=1e-6)


def test_a_mended_cause_and_the_plain_model(fitted):
    study, path, _ = fitted
    twin = Twin.read(path, study, NEW)
    force = {"force": torch.from_numpy(2.0 * np.sin(5.0 * NEW))}
    full, half, none = (twin.with_share(s).simulate(force) for s in (1.0, 0.5, 0.0))
    assert torch.equal(full, twin.simulate(force))
    assert (full - none).abs().max() > 1.5 * (half - none).abs().max() > 1e-3
    only = twin.with_share(0.0, ["delay"]).simulate(force)
    assert (only - full).abs().max() > 1e-3 < (only - none).abs().max()
    assert twin.plain().causes == ()
    with pytest.raises(ValueError, match="delay"):
        twin.with_share(0.0, ["delays"])


def test_draws_have_the_posteriors_spread_and_correlation(fitted):
    study, path, _ = fitted
    twin = Twin.read(path, study, NEW)
    names = [p.name for p in twin.model.base]
    q = twin.draw(4000, np.random.default_rng(0)).numpy()
    mass, delay = names.index("mass"), names.index("delay")
    assert np.abs(q).max() <= 3.0
    np.testing.assert_allclose(q.std(0), 1.0, atol=0.06)
    wanted = twin.saved.correlation_of("mass", "delay")
    assert np.corrcoef(q[:, mass], q[:, delay])[0, 1] == pytest.approx(wanted, abs=0.06)


@pytest.mark.story  # three best commands
def test_the_extended_models_command_serves_the_system_better_than_the_plain_ones(fitted):
    study, path, _ = fitted
    task, twin = TASK.for_study(study), Twin.read(path, study, TASK.time_s)
    best, plain = best_command(twin, task), best_command(twin.plain(), task)
    scores = [
        float(task.score(twin.simulate(task.commands(torch.from_numpy(found.knots)))))
        for found in (best, plain)
    ]
    assert scores[0] == pytest.approx(best.score, rel=1e-9)
    assert scores[0] < 0.4 * scores[1]
    draws = twin.draw(4, np.random.default_rng(0))
    robust = best_command(twin, task, at=draws)
    of_draws = [
        float(task.score(twin.simulate(task.commands(torch.from_numpy(knots)), draws)).norm() / 2)
        for knots in (robust.knots, best.knots)
    ]
    assert of_draws[0] == pytest.approx(robust.score, rel=1e-9)
    assert of_draws[0] <= of_draws[1] and robust.score < scores[1]


def test_what_it_buys_to_mend_a_cause(fitted):
    study, path, _ = fitted
    given = Tracking(
        seconds=0.6,
        every=0.02,
        knots=8,
        wanted={"place": {"course": "0.02", "miss": 0.001}},  # at once: late is late
    )
    twin = Twin.read(path, study, given.time_s)
    found = {row.cause: row for row in worth(twin, given.for_study(study), evaluations=80)}
    assert set(found) == {"square_drag", "delay", "all"}
    late = found["delay"]
    assert 0.97 * late.whole > late.half > 1.03 * late.none and late.unaware > late.whole
    assert "best miss" in late.words and late.words.startswith("delay: ")
    in_cm = replace(study, channels=tuple(replace(c, shown_unit="cm") for c in study.channels))
    twin = Twin.read(path, in_cm, given.time_s)
    of_user = worth(twin, given.for_study(in_cm), evaluations=2)[0]
    assert of_user.unit == "cm" and of_user.read(3.0) == "0.3 cm"  # of a miss of 1 mm


def test_refuses_other_systems_and_commands_without_bounds(fitted):
    study, path, _ = fitted
    with pytest.raises(ValueError, match=r"model\.system"):
        Twin.read(path, study.__class__(**{**vars(study), "model": {"system": "rod"}}), NEW)
    with pytest.raises(ValueError, match="force has no bounds"):
        TASK.for_study(study.__class__(**{**vars(study), "commands": ()}))
    with pytest.raises(ValueError, match="command of the study"):
        Twin.read(path, study, NEW).simulate({"moment": torch.zeros(len(NEW)).double()})
    with pytest.raises(ValueError, match="command force must be finite, got 1 NaN"):
        Twin.read(path, study, NEW).simulate({"force": torch.tensor([torch.nan, *NEW[1:]])})


def test_a_command_begins_at_rest_wherever_that_is(fitted):
    def first(**bounds):
        given = TASK.model_copy(update={"commands": {"force": Bounds(**bounds)}})
        task = given.for_study(fitted[0])
        knots = torch.full((task.num_knots,), 0.9, dtype=torch.float64)
        return float(task.commands(knots)["force"][0])

    assert first(least=-4.0, most=4.0) == pytest.approx(0.0)
    assert first(least=1.0, most=2.0) == pytest.approx(1.5)
    assert first(least=1.0, most=2.0, rest=1.2) == pytest.approx(1.2)
    assert first(least=3.0, most=3.0) == 3.0
    with pytest.raises(ValueError, match="least, rest, most must rise"):
        Bounds(least=1.0, most=2.0, rest=3.0)
