"""Small described soft bodies for tests, with records made by the model itself."""

from typing import Any

import numpy as np
import torch
import yaml

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.description import Description
from diffsim.systems.registry import description_of

BAR = """
system: soft_body
body: {bar: {size: [80 mm, 16 mm, 16 mm], cells: [5, 1, 2]}}
material: {youngs_modulus: {value: 0.3 MPa, percent: 30}, density: 1100,
           rayleigh_beta: {value: 4 ms, percent: 50}}
fixed: [{x: 0}]
masses: [{name: weight, where: {x: 80 mm}, mass_from: load_kg, acts_as: weight}]
markers: {tip: [80 mm, 8 mm, 8 mm]}
channels: {tip_z_m: {markers: tip, axis: z}}
start: {shape: held, where: {x: 80 mm}, axes: z, at: 0}
numerics: {time_step: 8 ms, correct_mesh: false}
"""

TENDON = """
system: soft_body
body: {bar: {size: [80 mm, 10 mm, 16 mm], cells: [5, 1, 2]}}
material: {youngs_modulus: {value: 0.3 MPa, percent: 30}, density: 1100}
fixed: [{x: 0}]
gravity: {vector: [0, 0, 0]}
tendons:
  - {name: cable, command: pull_m, path: [[0, 5 mm, 4 mm], [80 mm, 5 mm, 4 mm]],
     axial_stiffness: {value: 300, percent: 30}}
markers: {tip: [80 mm, 5 mm, 8 mm]}
channels: {tip_z_m: {markers: tip, axis: z}}
numerics: {motion: quasi_static, poses: 8, correct_mesh: false, tolerance: 1.0e-10}
"""


def study_of(
    text: str,
    runs: tuple[Run, ...],
    measured: tuple[Channel, ...] = (Channel("tip_z_m", "m", "position", 1e-4),),
    **changes: Any,
) -> Study:
    """A study with a described model, some of whose keys are replaced."""
    model = yaml.safe_load(text)
    return Study("case", "soft_body", measured, runs, model=model | changes)


def run_of(
    name: str, times: np.ndarray, num_channels: int = 1, use: str = "fit", **given: Any
) -> Run:
    """A run without measured values."""
    blank = np.zeros((len(times), num_channels))
    return Run(name, times, blank, given.pop("command", {}), name, use=use, setup=given)


def described(study: Study) -> Description:
    """The description of a study, checked."""
    return description_of(study)


def predicted(study: Study, sizes: dict[str, float] | None = None, **base: float) -> list[Any]:
    """Channels of all runs, with causes of some sizes and base parameters off their priors."""
    setup = description_of(study).setup(study)
    q = torch.tensor([base.get(p.name, 0.0) for p in setup.model.base], dtype=torch.float64)
    known = {e.name: e for e in setup.effects}
    effects = {known[n]: torch.tensor([size]).double() for n, size in (sizes or {}).items()}
    with torch.no_grad():
        return [setup.model.predict(run, q, effects) for run in study.runs]
