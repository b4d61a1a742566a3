"""A rig of four readings that differ from day to day, with faults in some groups."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Channel, Run, Study
from diffsim.identify import Effect, Parameter, SimModel
from diffsim.identify.setup import DiagnosisSetup

LEVEL = np.array([1.0, 0.8, 1.2, 0.9])
DAY, GAIN, NOW = 0.03, 0.02, 0.005  # true spreads: of all readings, of each, and of each run
NOISE, NUM_SAMPLES, NUM_RUNS = 0.01, 6, 3
KITS = {"old": (1.0, 1.0, 1.0, 1.0), "worn": (1.15, 0.9, 1.2, 0.85), "new": (0.85, 1.1, 0.9, 1.1)}
SCATTER = ["shift", ["gain_0", "gain_1", "gain_2", "gain_3"], "now"]
PATTERN = {"first": (1, 0, 0, 0), "second": (0, 1, 0, 0), "rear": (0, 0, 1, 1)}


@dataclass(frozen=True)
class Scene:
    """Readings of a run, (..., 4)."""

    readings: torch.Tensor

    def simulate(self) -> torch.Tensor:
        """(..., NUM_SAMPLES, 4)."""
        return self.readings[..., None, :].repeat_interleave(NUM_SAMPLES, dim=-2)


def _cause(name: str) -> Effect:
    pattern = torch.tensor(PATTERN[name], dtype=torch.float64)

    def apply(scene: Scene, size: torch.Tensor, run: Run) -> Scene:
        return Scene(scene.readings * (1.0 + pattern * size / (1.0 - 0.5 * size)))

    return Effect(
        name=name,
        family=name,
        kind="actuator",
        unit="-",
        typical=0.1,
        signed=False,
        apply=apply,
        words=f"{name} by {{:.2f}}".format,
    )


CAUSES = tuple(_cause(name) for name in PATTERN)


def keys(**changes: object) -> FaultKeys:
    """``faults`` of the rig."""
    given = {
        "per": "day",
        "scatter": SCATTER,
        "known": {"fact": "said", "causes": {"sound": [], "first": "first"}},
        "together": ["first", "second"],
    }
    return FaultKeys.model_validate({**given, **changes})


def group(
    label: str,
    rng: np.random.Generator,
    sizes: dict[str, float],
    said: str = "?",
    *,
    off: float = 0.0,
    kit: str = "?",
) -> list[Run]:
    """Runs of one group; ``off`` is added to the last reading and is no cause of the library."""
    level = LEVEL * np.array(KITS.get(kit, (1.0, 1.0, 1.0, 1.0)))
    level = level * (1.0 + DAY * rng.standard_normal() + GAIN * rng.standard_normal(4))
    for name, size in sizes.items():
        level = level * (1.0 + np.array(PATTERN[name]) * size / (1.0 - 0.5 * size))
    level = level + np.array([0.0, 0.0, 0.0, off])
    runs = []
    for k in range(NUM_RUNS):
        mean = level + LEVEL * NOW * rng.standard_normal()
        measured = mean + NOISE * rng.standard_normal((NUM_SAMPLES, 4))
        runs.append(
            Run(
                f"{label}_{k}",
                np.arange(NUM_SAMPLES) * 0.1,
                measured,
                {},
                f"{label}_{k}",
                use="fit" if said != "?" else "test",
                setup={"day": label, "said": said, "kit": kit},
            )
        )
    return runs


def study(runs: Sequence[Run], **changes: object) -> Study:
    """Study of these runs."""
    channels = tuple(Channel(f"y{i}", "-", "quantity", NOISE) for i in range(4))
    return Study("days", "bench", channels, tuple(runs), faults=keys(**changes))


def setup(made: Study) -> DiagnosisSetup:
    """Model and causes of a study."""
    days = dict.fromkeys(str(run.setup["day"]) for run in made.runs)
    base = [Parameter(f"level_{i}", float(v), 0.2) for i, v in enumerate(LEVEL)]
    for day in days:
        base.append(Parameter(f"shift[day={day}]", 0.0, 0.02))
        base += [Parameter(f"gain_{i}[day={day}]", 1.0, 0.02) for i in range(4)]
    if made.faults is not None and made.faults.state is not None:
        kits = dict.fromkeys(str(run.setup["kit"]) for run in made.runs)
        base += [Parameter(f"kit_{i}[kit={k}]", 1.0, 0.05) for k in kits for i in range(4)]
    base += [Parameter(f"now@{run.name}", 0.0, 0.005) for run in made.runs]

    def build(values, run, numerics):
        day = run.setup["day"]
        shared = 1.0 + values[f"shift[day={day}]"] + values[f"now@{run.name}"]
        one = torch.ones((), dtype=torch.float64)
        kit = [values.get(f"kit_{i}[kit={run.setup['kit']}]", one) for i in range(4)]
        rows = [
            values[f"level_{i}"] * shared * values[f"gain_{i}[day={day}]"] * kit[i]
            for i in range(4)
        ]
        return Scene(torch.stack(torch.broadcast_tensors(*rows), dim=-1))

    return DiagnosisSetup(SimModel(build, base, "days", batched=True), CAUSES)
