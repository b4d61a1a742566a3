"""``python -m benchmarks.nano_drone``: any extended model by the rule of the nano-drone benchmark.

Errors 1 to 50 samples ahead from every sample, summed (``benchmarks.ahead``). The published model
and "hold everything" are scored beside it: on ``melon_a`` they must give 2.230 m, 10.234 m/s,
5.021 rad, 28.458 rad/s and 17.68, 38.70, 8.16, 28.46. ``--model`` takes files or folders of
``diffsim diagnose explain nano_drone``; ``--runs`` takes other flights than the test flight.
``--refit OUT`` first fits the sizes of the model by the same rule on the flights of use fit
(``benchmarks.ahead_fit``).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
import yaml
from torch import Tensor

from benchmarks.ahead import AHEAD, Predict, Record, compared, flown, naive
from benchmarks.ahead_fit import Flights, fitted, free_names, save
from diffsim.core import interruptible
from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    quaternion_product,
)
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.registry import load_extended, setup_of

MODEL = Path(__file__).with_name("nano_drone_model.yaml")  # named causes, fitted by the rule
STUDY = Path(__file__).parents[1] / "diffsim/systems/published/nano_drone.yaml"
DT = 0.01
HELD = ("inertia_zz", "spin_up", "rate_damping.yaw")  # the yaw torque shows ratios to the first
FIT = ("square_1", "square_3", "square_5", "random1_1", "random2_1", "multisine_3")
EVERY = 220  # samples from start to start in a fit
# Published model: models/models.py of the benchmark's repository.
MASS, THRUST_CONSTANT, MOST_OVER_WEIGHT, PUBLISHED_GRAVITY = 0.045, 3.72e-8, 2.0, 9.81
HEAD = "| model | run | p, m | v, m/s | R, rad | rates, rad/s |\n|---|---|---|---|---|---|"


def whole_flights(names: Sequence[str]) -> Study:
    """The study of the published YAML with whole flights in place of its runs."""
    stated = yaml.safe_load(STUDY.read_text())
    stated["runs"] = [{"name": name, "file": f"{name}.csv"} for name in names]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(yaml.safe_dump(stated, sort_keys=False))
        return load_study(path)


def published(truth: Record, run: Run) -> Predict:
    """The published model: thrust along the body's z axis, body rates held, Runge-Kutta.

    Args:
        truth: Recording.
        run: The same, with the rotors' speeds.
    """
    squares = torch.stack([torch.as_tensor(run.command[f"n{i}"]) ** 2 for i in (1, 2, 3, 4)]).sum(0)
    pushes = (THRUST_CONSTANT * squares).clamp(max=MOST_OVER_WEIGHT * MASS * PUBLISHED_GRAVITY)

    def predict(starts: Tensor) -> Record:
        p, v, q, w = truth.at(starts).parts
        half = quaternion_from_rotation_vector(0.5 * DT * w)  # the rates are held: exact
        out = []
        for k in range(AHEAD):
            push = pushes[starts + k + 1] / MASS  # speeds of the sample that a step leads to
            middle = quaternion_product(q, half)
            after = quaternion_product(middle, half)
            first, second, third = (_pushed(push, at) for at in (q, middle, after))
            mean = (first + 4.0 * second + third) / 6.0
            p = p + DT * v + DT**2 * (first + 2.0 * second) / 6.0
            v, q = v + DT * mean, after
            out.append((p, v, q, w))
        return Record(*(torch.stack(part, 1) for part in zip(*out, strict=True)))

    return predict


def _pushed(push: Tensor, quaternion: Tensor) -> Tensor:
    """Acceleration under a push [m/s^2] along the body's z axis, (num_starts, 3)."""
    up = matrix_from_quaternion(quaternion)[..., 2]
    return push[:, None] * up - up.new_tensor([0.0, 0.0, PUBLISHED_GRAVITY])


def scores(
    name: str, models: Mapping[str, Path | None], every: int = 1, *, is_past_known: bool = True
) -> Iterator[tuple[str, list[float]]]:
    """Summed errors of the controls and of models on one flight.

    Args:
        name: Flight.
        models: Files of extended models by the name to be shown; None: the plain model.
        every: Samples from start to start; 1 is the rule.
        is_past_known: As of ``flown``.
    """
    study = whole_flights((name,))
    run = study.runs[0]
    truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float64))
    predictions: dict[str, Predict] = {"naive": naive(truth), "published": published(truth, run)}
    for shown, path in models.items():
        predictions[shown] = flown(_model(path, study), run, is_past_known=is_past_known)
    found = compared(predictions, truth, every)
    for shown, count in found.failed.items():
        print(f"{shown} cannot fly {count} of {found.num_starts} starts of {name}: left out of all")
    for shown, errors in found.errors.items():
        yield shown, errors.sum(0).tolist()


def _model(path: Path | None, study: Study) -> ExtendedModel:
    if path is not None:
        return load_extended(path, study)
    setup = setup_of(study)
    return ExtendedModel(setup.model, (), setup.model.base)


def refit(path: Path | None, out: Path) -> None:
    """Fit a model's sizes by the rule, on whole flights of use fit."""
    study = whole_flights(FIT)
    model = _model(path, study)
    free = free_names(model, HELD)
    save(model, fitted(model, free, Flights(study.runs, EVERY)), study.name, out)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--plain", action="store_true", help="the YAML's own numbers, too")
    parser.add_argument("--runs", default="melon_a", help="flights, comma between them")
    parser.add_argument("--every", type=int, default=1, help="samples from start to start")
    parser.add_argument(
        "--state-alone", action="store_true", help="nothing of the flight before each start is used"
    )
    parser.add_argument(
        "--refit", type=Path, help="file of the first model after a fit by the rule"
    )
    args = parser.parse_args(argv)
    if args.refit is not None:
        refit(args.model[0] if args.model else None, args.refit)
        args.model.append(args.refit)
    models: dict[str, Path | None] = {"plain": None} if args.plain else {}
    models |= {str(path): path for path in args.model}
    print(HEAD)
    for name in args.runs.split(","):
        for shown, row in scores(name, models, args.every, is_past_known=not args.state_alone):
            print(f"| {shown} | {name} | " + " | ".join(f"{x:.3f}" for x in row) + " |", flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
