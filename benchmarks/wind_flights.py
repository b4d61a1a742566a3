"""``python -m benchmarks.wind_flights --model FOLDER``: flights before fans, by the authors' score.

The score is the mean square over samples and the three components of the force residual [N^2] that
stands in the files (``residual_*``), less what a model says of it. The values that the description
states per flight (wind, hover gain, gust) are fitted to the whole flight, to its accelerations, as
the authors' coefficients are; all that flights share is as ``explain`` wrote it. Rows:

- ``nothing``: the residual itself; ``constant``: less its mean;
- ``named``: less what the saved model says, no flight with a gust;
- ``gust``: the same, where the gust of a flight is beyond what its prior allows (``LIMIT``).

The mass that turns accelerations into newtons is read off the residuals, for nothing else.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from scipy.optimize import least_squares

from diffsim.core import interruptible
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.registry import load_extended

STUDY = Path(__file__).parents[1] / "diffsim/systems/published/wind_flights.yaml"
GRAVITY = 9.81  # as the study says
LIMIT = 3.0  # standard deviations of its prior: a gust beyond is named
GUST = ("gust_sine", "gust_cosine", "gust_frequency")

Array = NDArray[np.float64]


class Flight(NamedTuple):
    """What one flight shows.

    Attributes:
        run: The flight, at its full rate.
        scores: Mean squares [N^2] by row of the table.
        values: Its own numbers by name, with standard deviations.
        force: Mean force from outside along x and y [N], gravity and thrust as commanded taken off.
    """

    run: Run
    scores: dict[str, float]
    values: dict[str, tuple[float, float]]
    force: tuple[float, float]


def full_rate_study() -> Study:
    """The study of the published YAML at the full rate, with the authors' residuals beside."""
    stated = yaml.safe_load(STUDY.read_text())
    stated["defaults"] = {}
    stated.pop("ignore")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(yaml.safe_dump(stated, sort_keys=False))
        return load_study(path)


def unexplained(run: Run) -> Array:
    """Acceleration that gravity and the thrust as commanded do not explain, (num_samples, 3)."""
    return np.asarray(run.measured) - _commanded(run)


def _commanded(run: Run) -> Array:
    u = run.command["thrust_command"] / run.command["hover_throttle"]
    x, y, z, w = (run.command[k] for k in ("qx", "qy", "qz", "qw"))
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], 1)
    return np.asarray(GRAVITY * u[:, None] * up - [0.0, 0.0, GRAVITY])


def residual_of(run: Run) -> Array:
    """The authors' force residual [N], (num_samples, 3)."""
    return np.stack([run.columns[f"residual_{axis}"] for axis in "xyz"], 1)


def mass_of(runs: Sequence[Run]) -> float:
    """Mass [kg] by which the authors' residuals are forces: their slope over accelerations."""
    force = np.concatenate([residual_of(r).ravel() for r in runs])
    push = np.concatenate([unexplained(r).ravel() for r in runs])
    return float(force @ push / (push @ push))


def _places(model: ExtendedModel, run: Run, names: Sequence[str]) -> list[int]:
    """Places of a flight's own parameters among all."""
    own = {f"{name}@{run.name}" for name in names}
    return [i for i, p in enumerate(model.base) if p.name in own]


def fit_own(model: ExtendedModel, run: Run, names: Sequence[str]) -> tuple[Array, Array, Array]:
    """Values of a flight's own parameters by its accelerations, all others as saved.

    Returns:
        Standardized coordinates of all parameters, the predicted channels, and the standard
        deviations of the coordinates of ``names`` (from the misfit of samples half a second apart:
        what is left lasts for less).
    """
    places = _places(model, run, names)
    measured = np.asarray(run.measured)
    there = np.isfinite(measured)

    def predict(q: Array) -> Array:
        full = torch.zeros(len(q), len(model.base), dtype=torch.float64)
        full[:, places] = torch.from_numpy(q)
        with torch.no_grad():
            return np.asarray(model.predict_many(run, full).numpy())

    def left(q: Array) -> Array:
        return (predict(q[None])[0] - measured)[there]

    def slopes(q: Array) -> Array:
        step = 1e-4
        moved = predict(q + step * np.vstack([np.zeros(len(q)), np.eye(len(q))]))
        return np.stack([(m - moved[0])[there] / step for m in moved[1:]], 1)

    found = least_squares(left, np.zeros(len(places)), jac=slopes, x_scale="jac")
    rate = 1.0 / float(np.median(np.diff(run.time_s)))
    variance = (
        0.5 * rate * float(np.mean(found.fun**2))
    )  # of one of two independent samples a second
    sd = np.sqrt(np.diag(variance * np.linalg.pinv(found.jac.T @ found.jac)))
    full = np.zeros(len(model.base))
    full[places] = found.x
    return full, predict(found.x[None])[0], np.asarray(sd)


def judge_flight(model: ExtendedModel, run: Run, mass: float) -> Flight:
    """Scores and own values of a flight."""
    names = list(dict.fromkeys(p.name.partition("@")[0] for p in model.base if "@" in p.name))
    residual, commanded = residual_of(run), _commanded(run)
    scores = {"nothing": residual, "constant": residual - residual.mean(0)}
    values: dict[str, tuple[float, float]] = {}
    for row in ("named", "gust"):
        free = [n for n in names if row == "gust" or n not in GUST]
        q, predicted, sd = fit_own(model, run, free)
        if row == "gust" and not _is_gusty(model, run, q):
            scores[row] = scores["named"]
            continue
        scores[row] = residual - mass * (predicted - commanded)
        own = [
            (i, p) for i, p in enumerate(model.base) if p.name in {f"{n}@{run.name}" for n in free}
        ]
        for (i, p), width in zip(own, sd, strict=True):
            scale = p.sd * (p.value if p.log else 1.0)
            value = float(p.value_at(torch.tensor(q[i], dtype=torch.float64)))
            values[p.name.partition("@")[0]] = value, scale * float(width)
    force = mass * unexplained(run).mean(0)
    means = {name: float((left**2).mean()) for name, left in scores.items()}
    return Flight(run, means, values, (float(force[0]), float(force[1])))


def _is_gusty(model: ExtendedModel, run: Run, q: Array) -> bool:
    """Whether the amplitude is beyond the prior, in its standard deviations."""
    places = [
        i for i, p in enumerate(model.base) if p.name in {f"{n}@{run.name}" for n in GUST[:2]}
    ]
    priors = [model.base[i] for i in places]
    size = [p.value + p.sd * q[i] for i, p in zip(places, priors, strict=True)]
    return float(np.hypot(*size)) > LIMIT * TYPICAL


TYPICAL = float(
    str(yaml.safe_load(STUDY.read_text())["model"]["swings"][0]["typical"]).split()[0]
)  # amplitude without surprise [m/s]


def main(argv: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True, help="folder that explain wrote")
    args = parser.parse_args(argv)
    study = full_rate_study()
    model = load_extended(args.model, study)
    mass = mass_of([r for r in study.runs if r.use == "fit"])
    print(f"mass by the authors' residuals: {mass:.3f} kg")
    flights = [judge_flight(model, run, mass) for run in study.runs]
    rows = ("nothing", "constant", "named", "gust")
    print(
        "| flight | use | "
        + " | ".join(rows)
        + " | force x, y, N | wind x, y, m/s | gust, m/s, period, s |"
    )
    print("|---" * 9 + "|")
    for flight in flights:
        print(_format(flight, rows))
    for use in ("fit", "select", "test"):
        of = [f for f in flights if f.run.use == use]
        means = " | ".join(f"{np.mean([f.scores[r] for f in of]):.2f}" for r in rows)
        print(f"| mean of {len(of)} | {use} | {means} | | | |")


def _format(flight: Flight, rows: Sequence[str]) -> str:
    v = flight.values
    wind = ", ".join(f"{v[k][0]:.1f} +- {v[k][1]:.1f}" for k in ("wind_x", "wind_y"))
    gust = "none"
    if GUST[0] in v:
        (sine, sd), (cosine, _), (hertz, width) = (v[k] for k in GUST)
        gust = (
            f"{np.hypot(sine, cosine):.2f} +- {sd:.2f}, {1 / hertz:.3f} +- {width / hertz**2:.3f}"
        )
    means = " | ".join(f"{flight.scores[r]:.2f}" for r in rows)
    force = ", ".join(f"{x:.2f}" for x in flight.force)
    return f"| {flight.run.name} | {flight.run.use} | {means} | {force} | {wind} | {gust} |"


if __name__ == "__main__":
    with interruptible():
        main()
