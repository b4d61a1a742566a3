"""A joint that friction stops between its moves: what a slope at no friction cannot say."""

import numpy as np

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.diagnose.search.from_prior import center_at_prior
from diffsim.diagnose.search.search import begin
from diffsim.diagnose.search.simulations import NONE, Simulations
from diffsim.systems.registry import setup_of

STEP, STIFFNESS, DAMPING, INERTIA, FRICTION, NOISE = 0.02, 19.0, 0.8, 0.02, 1.1, 1e-3
T = STEP * np.arange(150)
ONLY = [
    "dry_friction_at_joint",
    "viscous_friction_at_joint",
    "constant_force_at_joint",
    "lag",
    "backlash",
    "rate_limit",
]
MODEL = {
    "system": "ode",
    "parameters": {
        "k": {"value": 15.0, "percent": 60},
        "d": {"value": 0.6, "percent": 60},
        "I": {"value": 0.03, "percent": 60},
    },
    "inputs": [{"name": "goal", "held": True}],
    "states": {"q": 0, "w": 0},
    "define": {"torque": "k*(goal - q) - d*w"},
    "rates": {"q": "w", "w": "torque/I"},
    "readings": {"angle": "q"},
    "places": [
        {"name": "joint", "position": "q", "velocity": "w", "inertia": "I", "force": "torque",
         "unit": "N m", "position_unit": "rad"}
    ],
    "effects": {"only": ONLY},
    "effort": {"max_effects": 2},
}  # fmt: skip


def record(goal: np.ndarray, friction: float) -> np.ndarray:
    """Angle of the joint by small steps; it stands while the drive is weaker than friction."""
    q, w, seen, h = 0.0, 0.0, [0.0], STEP / 40
    for held in goal[:-1]:
        for _ in range(40):
            push = STIFFNESS * (held - q) - DAMPING * w
            free = w + h * push / INERTIA
            w = np.sign(free) * max(abs(free) - h * friction / INERTIA, 0.0)
            q += h * w
        seen.append(q)
    return np.array(seen)


def joint(friction: float) -> Study:
    rng = np.random.default_rng(3)
    runs = []
    for k in range(4):
        goal = np.repeat([0.0, *rng.uniform(-0.3, 0.3, 14)], 10)
        angle = record(goal, friction) + NOISE * rng.normal(size=len(T))
        use = "test" if k == 3 else "fit"
        runs.append(Run(f"r{k}", T, angle[:, None], {"goal": goal}, f"r{k}", k, use))
    return Study(
        "joint", "ode", (Channel("angle", "rad", "angle", NOISE),), tuple(runs), model=MODEL
    )


def test_sizes_of_friction_that_stops_a_joint_show_it_at_a_poor_data_sheet():
    study = joint(FRICTION)
    setup = setup_of(study)
    null = null_fit(Case(study, setup.model, setup.effects, (), setup.settings))
    search = begin(null, Simulations(null.wide))
    center, _ = center_at_prior(search.simulations, search.settings, search.num_families)
    assert center is not None
    names = [effect.name for effect in null.wide.effects]
    rubs = frozenset({names.index("dry_friction_at_joint")})
    # by its slope at no friction 98 % of the misfit would stay
    assert center.weigh(rubs).nats > 0.4 * center.weigh(NONE).nats


def test_nothing_is_named_where_the_joint_is_free():
    study = joint(0.0)
    setup = setup_of(study)
    report = diagnose(
        study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns, settings=setup.settings
    )
    assert not report.named, report.sentences
