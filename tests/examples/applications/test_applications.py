"""Minimizing, resuming and comparing applications, on one whose answer is known."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from diffsim.core.errors import ConvergenceError, DiffsimError
from examples.applications import (
    Application,
    Parameters,
    evaluate,
    minimize,
    random_losses,
    solver_options,
)
from examples.applications.normalize import normalized

TRUTH = np.array([np.log(2e5), -3.0])


def made(method="projective_dynamics", **changes):
    """A bar that falls for a few steps; its stiffness and the weight are to be found."""
    m = mesh.hex_box(cells=(3, 1, 1), size=(0.06, 0.02, 0.02))
    body = soft.SoftBody(
        m,
        dt=0.01,
        youngs_modulus=1e5,
        poissons_ratio=0.4,
        fixed=m.nodes_near_plane("x", 0.0),
        solver=solver_options(method, rtol=1e-10),
    )

    def simulate(p):
        pull = torch.cat([torch.zeros(2, dtype=p.dtype), p[1:]])
        physics = body.physics(youngs_modulus=p[0].exp(), gravity=pull)
        return soft.rollout(body, body.rest_state(), 10, physics=physics).x

    with torch.no_grad():
        target = simulate(torch.tensor(TRUTH))
    whole = dict(
        name="bar",
        title="",
        source="test",
        body=body,
        parameters=Parameters(
            names=("log E", "g"),
            lower=np.array([np.log(5e4), -8.0]),
            upper=np.array([np.log(8e5), -1.0]),
            first=np.array([np.log(1e5), -6.0]),
        ),
        simulate=simulate,
        loss=lambda _p, x: (x - target).square().sum(),
        numbers=lambda values, _x: {"E": float(np.exp(values[0]))},
        oracle_parameters=TRUTH,
    )
    return Application(**(whole | changes))


def test_gradient_is_the_central_difference():
    application, at, eps = made(), np.array([np.log(1e5), -6.0]), 1e-5
    found = evaluate(application, at)
    for k in range(2):
        step = eps * np.eye(2)[k]
        up, down = (evaluate(application, at + s, gradient=False).loss for s in (step, -step))
        assert found.gradient[k] == pytest.approx((up - down) / (2 * eps), rel=1e-5)


@pytest.mark.parametrize("method", ["projective_dynamics", "newton_cholesky", "newton_pcg"])
def test_every_solver_finds_the_truth(method):
    found = minimize(made(method), max_evaluations=60, ftol=1e-14, gtol=1e-12)
    assert np.array(found.best.values) == pytest.approx(TRUTH, rel=1e-3)


def test_interrupted_minimization_goes_on_without_repeating(tmp_path):
    record = tmp_path / "bar.jsonl"
    whole = minimize(made(), max_evaluations=12)
    minimize(made(), max_evaluations=5, record=record)
    record.write_text(record.read_text() + '{"values": [1.0, ')  # cut off in a line
    calls = []
    application = made()
    simulate = application.simulate

    def counted(p):
        calls.append(p)
        return simulate(p)

    resumed = minimize(
        dataclasses.replace(application, simulate=counted), max_evaluations=12, record=record
    )
    assert len(calls) == len(whole.evaluations) - 5
    assert [e.loss for e in resumed.evaluations] == [e.loss for e in whole.evaluations]
    assert minimize(made(), max_evaluations=12, record=record).best.loss == whole.best.loss


def test_records_of_an_older_version_or_of_other_bounds_are_refused(tmp_path):
    record = tmp_path / "bar.jsonl"
    record.write_text(json.dumps({"values": [1.0], "loss": 1.0, "with_gradient": True}) + "\n")
    with pytest.raises(ValueError, match="older version"):
        minimize(made(), max_evaluations=2, record=record)
    record.unlink()
    minimize(made(), max_evaluations=1, record=record)
    wider = dataclasses.replace(made().parameters, upper=np.array([np.log(9e5), -1.0]))
    with pytest.raises(ValueError, match="belongs to another run"):
        minimize(made(parameters=wider), max_evaluations=1, record=record)


def test_failed_simulation_is_stepped_back_from():
    application = made()
    simulate = application.simulate

    def fragile(p):
        if float(p[1].detach()) > -4.0:  # beyond the first guess, before the truth
            raise ConvergenceError("made up", residual_norm=1.0, tolerance=0.1, num_iters=3)
        return simulate(p)

    found = minimize(dataclasses.replace(application, simulate=fragile), max_evaluations=40)
    assert any(e.failure for e in found.evaluations)
    assert found.best.loss < 0.5 * found.evaluations[0].loss
    with pytest.raises(DiffsimError, match="first guess"):
        first = dataclasses.replace(application.parameters, first=np.array([np.log(1e5), -2.0]))
        minimize(dataclasses.replace(application, simulate=fragile, parameters=first))


def test_best_of_random_starts_is_the_first_guess():
    application = made(num_starts=6)
    found = minimize(application, max_evaluations=3, seed=3)
    tries = found.evaluations[: found.num_starts]
    assert len(tries) == 6 and len({tuple(e.values) for e in tries}) == 6
    assert found.evaluations[6].values == min(tries, key=lambda e: e.loss).values


def test_random_losses_are_kept_and_normalize_to_one(tmp_path):
    application, record = made(), tmp_path / "random.jsonl"
    losses = random_losses(application, record=record, count=4)
    assert losses == random_losses(made(), record=record, count=4)
    assert len(record.read_text().splitlines()) == 1 + 4  # a header, and a line per loss
    assert normalized(np.mean(losses), np.mean(losses), 0.3) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first": np.array([9.0, -4.0])}, "first must lie"),
        ({"lower": np.array([0.0, 2.0])}, "lower must be below upper.*g"),
        ({"upper": np.zeros(3)}, "upper must be 2 finite"),
        ({"lower": np.array([np.nan, 0.0])}, "lower must be 2 finite"),
    ],
)
def test_bad_parameters_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(made().parameters, **change)


def test_a_motion_that_is_asked_for_again_is_not_simulated_again():
    application, calls = made(), []
    simulate = application.simulate

    def counted(p):
        calls.append(p)
        return simulate(p)

    application = dataclasses.replace(application, simulate=counted)
    first = application.motion(TRUTH)
    assert application.motion(TRUTH.copy()) is first
    assert not first.requires_grad
    assert application.motion(TRUTH + 0.01) is not first
    assert len(calls) == 2


def test_strip_shows_the_point_that_is_followed(tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    from examples.applications.pictures import motion_strip

    application = made()
    x = {"swing": application.motion(TRUTH)}
    plain = motion_strip(application, x, tmp_path / "plain.png", frames=2)
    followed = dataclasses.replace(application, follow=lambda x: x.mean(-2))
    dotted = motion_strip(followed, x, tmp_path / "dotted.png", frames=2)
    a, b = plt.imread(plain), plt.imread(dotted)
    assert a.shape == b.shape
    assert (a != b).any()
    assert plt.get_fignums() == []


def test_a_warm_up_makes_the_first_guess(tmp_path):
    easier = made(name="easier")
    application = made(warm_up=easier)
    found = minimize(application, max_evaluations=8, record=tmp_path / "bar.jsonl")
    before = minimize(easier, max_evaluations=8, ftol=1e-6, gtol=1e-6)
    assert found.num_warm_up == len(before.evaluations)
    assert found.evaluations[0].values == pytest.approx(before.best.values, rel=1e-12)
    assert (tmp_path / "warm_up_bar.jsonl").is_file()
