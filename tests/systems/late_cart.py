"""A cart with drag by the square of its speed and a late command, and its extended model."""

import numpy as np
import torch

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.identify import fit
from diffsim.identify.model_file import save_extended
from diffsim.sim_to_real import Tracking
from diffsim.systems import setup_of

T = 0.02 * np.arange(61.0)
NEW = 0.02 * np.arange(51.0)
MODEL = {
    "system": "ode",
    "states": {"x": "0 m", "v": "0 m/s"},
    "rates": {"x": "v", "v": "(force - damping*v - spring*x)/mass"},
    "inputs": [{"name": "force", "held": False}],
    "parameters": {
        "mass": {"value": 1.2, "percent": 7, "unit": "kg"},
        "damping": {"value": 1.0, "percent": 50, "unit": "N s/m"},
        "spring": {"value": 40.0, "percent": 15, "unit": "N/m"},
    },
    "readings": {"place": "x"},
    "places": [{"name": "rail", "position": "x", "velocity": "v", "inertia": "mass"}],
}
TASK = Tracking(
    seconds=1.0,
    every=0.02,
    knots=12,
    wanted={"place": {"course": "0.05*sin(4*t)*t", "miss": 0.001}},
)


def study_of(measured):
    runs = [
        Run(f"run_{k}", T, y, {"force": 3.0 * np.sin((4 + k) * T)}, f"run_{k}", k)
        for k, y in enumerate(measured)
    ]
    return Study(
        "cart",
        "ode",
        (Channel("place", "m", "position", sd=5e-4),),
        tuple(runs),
        model=MODEL,
        commands=(Command("force", "N", -4.0, 4.0),),
    )


def fitted_cart(folder):
    """Study, path of its extended model in a folder, and the fit that it was written from."""
    study = study_of([np.zeros((len(T), 1))] * 3)
    setup = setup_of(study)
    causes = [e for e in setup.effects if e.name in ("square_drag", "delay")]
    truth = {
        e: torch.tensor([{"square_drag": 2.0, "delay": 0.03}[e.name]]).double() for e in causes
    }
    q = torch.zeros(len(setup.model.base), dtype=torch.float64)
    rng = np.random.default_rng(3)
    seen = [setup.model.predict(r, q, truth).detach().numpy() for r in study.runs]
    study = study_of([y + 5e-4 * rng.standard_normal(y.shape) for y in seen])
    setup = setup_of(study)
    causes = [e for e in setup.effects if e.name in ("square_drag", "delay")]
    found = fit(setup.model, study.fit_runs, study.channels, effects=causes)
    plain = fit(setup.model, study.fit_runs, study.channels)
    path = folder / "extended_model.yaml"
    save_extended(found, path, study=study, verdict="named", plain=plain)
    return study, path, found
