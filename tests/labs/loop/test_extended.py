"""The swimmer with a diagnosis's causes: gradients, draws, robust strokes, what mending buys."""

import json

import numpy as np
import pytest
import torch

from diffsim.systems import Twin
from labs.loop import Command, Limits, Starfish, TrajectorySettings, optimize
from labs.loop.records import LoopSettings, open_loop
from labs.loop.trajectory import travel_loss
from labs.loop.worth import worth_of_travel
from tests.labs.loop.test_optimizations import PULL
from tests.systems.late_cart import fitted_cart
from tests.systems.slack_starfish import TRUTH, fitted_starfish

LIMITS = Limits(contraction_m=0.012, rate_m_s=0.3)
SETTINGS = TrajectorySettings(periods=1, num_knots=8, max_evaluations=3)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Swimmer with the causes of a file, values of its parameters, content of the file."""
    folder = tmp_path_factory.mktemp("starfish")
    study = fitted_starfish(folder)
    model = Starfish(rtol=1e-8).extended(folder, study)
    return (
        model,
        {p.name: p.value for p in model.parameters},
        Twin.read(folder, study, 0.01 * np.arange(len(PULL))).saved,
    )


def test_causes_become_parameters_with_the_files_posterior(made):
    model, values, saved = made
    assert [e.name for e in model.causes] == ["slack"]
    assert values["slack"] == pytest.approx(TRUTH["slack"], rel=0.05)
    slack = model.parameters[-1]
    assert (slack.name, slack.sd) == ("slack", pytest.approx(saved.sd["slack"]))
    assert "tendon_gain" not in values  # of the study's own body


def test_slack_takes_its_length_off_the_pull(made):
    model, values, _ = made
    pull = torch.from_numpy(PULL)
    with torch.no_grad():
        slack = model.motion(values, pull)
        plain = Starfish(rtol=1e-8)
        known = {p.name: values[p.name] for p in plain.parameters}
        shorter = plain.motion(known, (pull - values["slack"]).clamp(min=0.0))
        mended = model.motion(model.mended(values, 0.0), pull)
        whole = plain.motion(known, pull)
    torch.testing.assert_close(slack, shorter, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(mended, whole, rtol=0.0, atol=1e-12)


@pytest.mark.grad
def test_gradient_of_the_travel_in_the_size_of_a_cause(made):
    model, values, _ = made
    pull, h = torch.from_numpy(PULL + 1e-3), 1e-6
    size = torch.tensor(values["slack"], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(travel_loss(model, values | {"slack": size}, pull, 1), size)
    with torch.no_grad():
        ends = [
            float(travel_loss(model, values | {"slack": values["slack"] + s * h}, pull, 1))
            for s in (1, -1)
        ]
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1e-4)


def test_draws_differ_and_come_again_by_their_seed(made):
    model, values, saved = made
    drawn = model.draw(values, saved, 3, np.random.default_rng(2))
    assert drawn == model.draw(values, saved, 3, np.random.default_rng(2))
    assert len({one["slack"] for one in drawn}) == 3
    assert all(one["drag_1"] == values["drag_1"] for one in drawn)


def test_a_stroke_for_draws_is_good_in_their_mean(made):
    model, values, saved = made
    drawn = model.draw(values, saved, 2, np.random.default_rng(2))
    found = optimize(model, drawn, Command(PULL), LIMITS, SETTINGS)
    period = torch.from_numpy(found.command.contraction_m)
    with torch.no_grad():
        each = [float(travel_loss(model, one, period, 1)) for one in drawn]
    assert np.mean(each) == pytest.approx(found.loss_after, rel=1e-9)
    assert found.loss_after < found.loss_before


def test_what_it_buys_to_mend_the_slack(made):
    model, values, _ = made
    (row,) = worth_of_travel(model, values, Command(PULL), LIMITS, SETTINGS)
    assert row.none > row.half > row.whole > row.unaware
    assert "best travel" in row.words and row.words.startswith("slack: ")


def test_a_loops_folder_knows_the_causes(made, tmp_path):
    class Hardware:
        name, duration_s, limits = "bench", 1.0, LIMITS

    open_loop(tmp_path, made[0], Hardware(), LoopSettings(), resume=False)
    kept = json.loads((tmp_path / "loop.json").read_text(encoding="utf-8"))["model"]
    assert kept["causes"] == ["slack"]
    with pytest.raises(ValueError, match="another model"):
        open_loop(tmp_path, Starfish(rtol=1e-8), Hardware(), LoopSettings(), resume=True)


def test_causes_of_another_system_are_refused(tmp_path):
    study, path, _ = fitted_cart(tmp_path)
    with pytest.raises(ValueError, match="only command is the contraction"):
        Starfish().extended(path, study)
