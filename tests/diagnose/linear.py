"""A linear model of known matrices: everything the statistics claim has a closed form here."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from diffsim.data.study import Channel, Run
from diffsim.identify import Effect, Parameter, Problem, SimModel, WhiteNoise
from diffsim.identify.effect import PRIOR_WIDTH

CHANNELS = (Channel("a", "m", "position", sd=0.5), Channel("b", "m", "position", sd=2.0))
NUM_SAMPLES = 15


@dataclass
class LinearScene:
    record: torch.Tensor

    def simulate(self) -> torch.Tensor:
        return self.record


def shapes(name: str, run: Run, count: int = 1) -> torch.Tensor:
    """(T, 2, count) fixed random shapes of a name in a run."""
    rng = np.random.default_rng([*name.encode(), *run.name.encode()])
    return torch.from_numpy(rng.normal(size=(len(run.time_s), 2, count)))


def line(name, *, signed=True, typical=0.4, components=("size",), family=""):
    """An effect that adds the shapes of its name times its sizes."""

    def apply(scene, size, run):
        moved = shapes(name, run, len(components)) @ size
        return replace(scene, record=scene.record + moved)

    return Effect(
        name=name,
        family=family or name,
        kind="force",
        unit="N",
        typical=typical,
        signed=signed,
        components=components,
        apply=apply,
    )


def run(name: str, seed: int, **changes) -> Run:
    rng = np.random.default_rng(seed)
    time = 0.1 * np.arange(NUM_SAMPLES)
    measured = rng.normal(size=(NUM_SAMPLES, 2)) * [c.sd for c in CHANNELS]
    return Run(name, time, measured, {}, name, **changes)


def model() -> SimModel:
    def build(values, run, numerics):
        mass, gain = shapes("mass", run)[..., 0], shapes("gain", run)[..., 0]
        return LinearScene(values["mass"] * mass + values["gain"] * gain)

    base = [Parameter("mass", 0.3, 0.7, "kg"), Parameter("gain", -0.2, 1.5, "-")]
    return SimModel(build, base, "linear")


def problem(effects=(), runs=None) -> Problem:
    runs = runs or (run("r1", 1), run("r2", 2))
    return Problem(model(), tuple(runs), WhiteNoise(CHANNELS), tuple(effects))


def matrices(effects=(), runs=None) -> tuple[np.ndarray, np.ndarray]:
    """Whitened data y - S(0), (N,), and columns per standardized coordinate, (N, n)."""
    runs = runs or (run("r1", 1), run("r2", 2))
    sd = np.array([c.sd for c in CHANNELS])
    rights, columns = [], []
    for r in runs:
        mass, gain = (shapes(n, r).numpy()[..., 0] for n in ("mass", "gain"))
        rights.append(((r.measured - 0.3 * mass + 0.2 * gain) / sd).ravel())
        cols = [0.7 * mass / sd, 1.5 * gain / sd]
        for e in effects:
            s = shapes(e.name, r, len(e.components)).numpy()
            cols += [PRIOR_WIDTH * e.typical * s[..., k] / sd for k in range(len(e.components))]
        columns.append(np.stack([c.ravel() for c in cols], 1))
    return np.concatenate(rights), np.concatenate(columns)
