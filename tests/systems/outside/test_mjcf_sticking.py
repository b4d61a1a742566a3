"""A joint of an MJCF that friction stops: what a slope at no friction cannot say."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Study
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.diagnose.search.from_prior import center_at_prior
from diffsim.diagnose.search.search import begin
from diffsim.diagnose.search.simulations import NONE, Simulations
from diffsim.systems.registry import setup_of
from tests.systems.outside import scenes

pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

from diffsim.systems.outside.mjcf import Mjcf
from tests.systems.outside.test_mjcf import CHANNELS, XML

FRICTION, NOISE = 0.4, 2e-3


def pendulum(folder) -> Study:
    """Two runs of a pendulum whose hinge rubs, and is said to be damped and heavier."""
    (folder / "pendulum.xml").write_text(XML)
    options = {"model": "pendulum.xml", "channels": {"angle_rad": CHANNELS["angle_rad"]}}
    rng, runs, sim = np.random.default_rng(3), [], Mjcf(XML, CHANNELS)
    for name in ("sine", "steps"):
        run = scenes.run_of(name)
        made = sim.predict({"joint.hinge.frictionloss": FRICTION}, run)[:, :1]
        noisy = made + NOISE * rng.standard_normal(made.shape)
        runs.append(replace(run, measured=noisy))
    model = {
        "system": "outside",
        "simulator": "diffsim.systems.outside.mjcf:Mjcf",
        "options": options,
        "parameters": {"joint.hinge.damping": {"value": 0.1, "percent": 60}},
        "hooks": {
            "force": {"hinge": {"unit": "N m", "typical": 0.1, "distance": 0.5, "speed": 3.0}}
        },
        "effects": {"only": ["dry_friction_at_hinge", "constant_force_at_hinge"]},
    }
    channel = Channel("angle_rad", "rad", "angle", sd=NOISE)
    return Study("pendulum", "outside", (channel,), tuple(runs), model=model, folder=folder)


def test_sizes_of_friction_that_stops_a_joint_are_tried(tmp_path):
    """A leg whose knee rubs was told a dead band of its drive: slopes gave friction no way."""
    study = pendulum(tmp_path)
    setup = setup_of(study)
    null = null_fit(Case(study, setup.model, setup.effects, (), setup.settings))
    search = begin(null, Simulations(null.wide))
    center, _ = center_at_prior(search.simulations, search.settings, search.num_families)
    assert center is not None
    names = [effect.name for effect in null.wide.effects]
    rubs = frozenset({names.index("dry_friction_at_hinge")})
    assert center.weigh(rubs).nats > 0.1 * center.weigh(NONE).nats
