"""Forces in a coupled mechanism: a cart with a pendulum, integrated here by scipy on its own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.registry import description_of, setup_of

CART, BOB, LENGTH, G, STEP = 1.2, 0.25, 0.4, 9.81, 0.01
MODEL = {
    "system": "ode",
    "parameters": {"M": {"value": CART, "percent": 3}, "m": BOB, "L": LENGTH},
    "inputs": [{"name": "force", "held": True}],
    "states": {"x": 0, "v": 0, "q": 0, "w": 0},
    "define": {
        "push": "force",
        "a": f"(push + m*sin(q)*(L*w**2 + {G}*cos(q)))/(M + m*sin(q)**2)",
    },
    "rates": {"x": "v", "v": "a", "q": "w", "w": f"-(a*cos(q) + {G}*sin(q))/L"},
    "readings": {"x": "x", "angle": "q"},
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "M", "force": "push"}],
}


def cart(drag: float) -> Study:
    """A run under a slow push, with viscous drag on the cart."""
    t = STEP * np.arange(200)
    force = 3.0 * np.sin(3.0 * t)

    def rates(s: float, y: np.ndarray) -> tuple[float, ...]:
        _, v, q, w = y
        total = force[min(int(s / STEP + 1e-9), len(t) - 1)] - drag * v
        a = (total + BOB * np.sin(q) * (LENGTH * w**2 + G * np.cos(q))) / (
            CART + BOB * np.sin(q) ** 2
        )
        return v, a, w, -(a * np.cos(q) + G * np.sin(q)) / LENGTH

    y = [np.zeros(4)]
    for k in range(len(t) - 1):  # the force jumps between two samples
        y.append(solve_ivp(rates, t[k : k + 2], y[-1], rtol=1e-10, atol=1e-12).y[:, -1])
    measured = np.array(y)[:, [0, 2]]
    run = Run("a", t, measured, {"force": force}, "a")
    channels = (Channel("x", "m", "position", 1e-3), Channel("angle", "rad", "angle", 1e-3))
    return Study("cart", "ode", channels, (run,), model=MODEL)


def predicted(study: Study, **sizes: float) -> np.ndarray:
    setup = setup_of(study)
    causes = {e.name: e for e in setup.effects}
    at = {causes[k]: torch.tensor([v], dtype=torch.float64) for k, v in sizes.items()}
    return setup.model.predict(study.runs[0], setup.model.at_prior(), at).numpy()


@pytest.mark.reference
def test_a_force_on_the_cart_reaches_the_pendulum():
    study = cart(0.8)
    seen = predicted(study, viscous_friction=0.8)
    np.testing.assert_allclose(seen, study.runs[0].measured, atol=2e-4)
    alone = replace(study, model=MODEL | {"places": [{**MODEL["places"][0], "force": None}]})
    off = predicted(alone, viscous_friction=0.8) - study.runs[0].measured
    assert np.abs(off[:, 1]).max() > 0.05  # the pendulum does not feel it


def test_forces_of_one_place_add_up():
    study = cart(0.0)
    one, both = (
        predicted(study, viscous_friction=0.8),
        predicted(study, viscous_friction=0.8, constant_force=0.5),
    )
    formula = MODEL | {"define": MODEL["define"] | {"push": "force - 0.8*v + 0.5"}}
    wanted = predicted(replace(study, model=formula))
    np.testing.assert_allclose(both, wanted, atol=1e-12)
    assert np.abs(both - one).max() > 0.01


def test_an_unknown_force_reaches_it_too():
    setup = setup_of(cart(0.0))
    effect = setup.unknowns[0].effect
    size = torch.full((len(effect.components),), 0.5, dtype=torch.float64)
    run = cart(0.0).runs[0]
    seen = setup.model.predict(run, setup.model.at_prior(), {effect: size}).numpy()
    np.testing.assert_allclose(seen, predicted(cart(0.0), constant_force=0.5), atol=1e-9)


def test_an_event_reaches_it_too():
    """It was added to the cart's rate alone."""
    place = {**MODEL["places"][0], "name": "cart"}
    study = replace(cart(0.0), model=MODEL | {"places": [place], "events": [{"at": ["cart"]}]})
    setup = setup_of(study)
    step = next(e for e in setup.effects if e.name == "step_event_at_cart")
    q = setup.model.at_prior()
    onset = next(i for i, p in enumerate(setup.model.base) if p.name == "event_onset")
    q[onset] = setup.model.base[onset].coordinate_of(-1.0)  # before the run
    seen = setup.model.predict(study.runs[0], q, {step: torch.tensor([0.5], dtype=q.dtype)})
    np.testing.assert_allclose(seen, predicted(cart(0.0), constant_force=0.5), atol=1e-9)


def test_a_force_that_is_not_there_is_told():
    place = {**MODEL["places"][0], "force": "psuh"}
    study = replace(cart(0.0), model=MODEL | {"places": [place]})
    (problem,) = description_of(study).problems(study)
    assert "places[0].force: no definition or input 'psuh'; did you mean 'push'" in str(problem)
