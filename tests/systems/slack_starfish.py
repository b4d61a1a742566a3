"""The starfish's leg with slack in its tendon, and its extended model."""

from pathlib import Path

import numpy as np
import torch
import yaml

import diffsim
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.identify import fit
from diffsim.identify.model_file import save_extended
from diffsim.sim_to_real import Tracking
from diffsim.systems import setup_of

PUBLISHED = Path(diffsim.__file__).parent / "systems/published/starfish.yaml"
TRUTH = {"slack": 0.004}  # m
T = np.arange(0.0, 2.0, 1.0 / 60.0)
NOISE_M = 5e-4
TASK = Tracking(
    seconds=1.0,
    every=1.0 / 60.0,
    knots=12,
    commands={"contraction": {"least": 0.0, "most": 0.009}},
    wanted={"closing": {"course": "0.008*(1 - cos(2*pi*t/0.5))", "miss": 0.001}},
)


def stroke(k: int) -> np.ndarray:
    """Contraction of a run [m]: strokes that get quicker."""
    return 0.008 * (1.0 - np.cos(2.0 * np.pi * (1.0 + 0.8 * k) * T))


def study_of(measured: list[np.ndarray]) -> Study:
    """Study of runs with these channels, (num_samples, 1) each."""
    runs = [
        Run(f"run_{k}", T, y, {"contraction": stroke(k)}, f"run_{k}", k)
        for k, y in enumerate(measured)
    ]
    return Study(
        "starfish",
        "soft_body",
        (Channel("closing", "m", "position", sd=NOISE_M),),
        tuple(runs),
        model=yaml.safe_load(PUBLISHED.read_text(encoding="utf-8"))["model"],
        commands=(Command("contraction", "m", 0.0, 0.018),),
    )


def truth_of(study: Study):
    """Function of a run: what the leg shows, (num_samples, 1) [m]."""
    setup = setup_of(study)
    hidden = {
        e: torch.tensor([TRUTH[e.name]], dtype=torch.float64)
        for e in setup.effects
        if e.name in TRUTH
    }
    q = torch.zeros(len(setup.model.base), dtype=torch.float64)
    return lambda run: setup.model.predict(run, q, hidden).detach().numpy()


def fitted_starfish(folder: Path) -> Study:
    """Study of two runs; its extended model is written to a folder."""
    rng, bare = np.random.default_rng(0), study_of([np.zeros((len(T), 1))] * 2)
    shown = truth_of(bare)
    study = study_of([shown(r) + NOISE_M * rng.standard_normal((len(T), 1)) for r in bare.runs])
    setup = setup_of(study)
    causes = [e for e in setup.effects if e.name in TRUTH]
    near = [0.7 * TRUTH[e.name] / e.typical for e in causes]  # as a scan of kinks leaves it
    start = np.array([0.0] * len(setup.model.base) + near)
    found = fit(setup.model, study.fit_runs, study.channels, effects=causes, start=start)
    plain = fit(setup.model, study.fit_runs, study.channels, max_evaluations=8)
    path = folder / "extended_model.yaml"
    save_extended(found, path, study=study, verdict="named", plain=plain)
    return study
