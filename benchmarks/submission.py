"""``python -m benchmarks.submission``: results in the form of the package ``nonlinear_benchmarks``.

``python -m benchmarks.submission cascaded_tanks --model FOLDER --out OUT`` simulates the model that
``diffsim diagnose explain`` saved. ``OUT/y_model.csv`` holds input, truth and prediction of the
test data, ``OUT/submission.json`` the number with its formula and unit, and why it is none to
submit. The package's own ``RMSE`` makes the number, by its rule: the samples in which a state may
be initialized do not count.

``--official`` takes the test data from the package, which downloads them. Without it they are the
recordings in ``DIFFSIM_DATA``; those hold no test record of the tanks, so that the last quarter of
the estimation record stands in. The package has no loader for the nano drone: the rule of that
benchmark's authors is applied, from every n-th start (``--every``; 1 is the rule).
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from benchmarks.nano_drone import scores
from diffsim.core import interruptible
from diffsim.core.paths import data_folder
from diffsim.data.study_file import load_study
from diffsim.systems.registry import load_extended

Array = NDArray[np.float64]
PUBLISHED = Path(__file__).parents[1] / "diffsim/systems/published"
RMSE = "sqrt(mean((y_test[n:] - y_model[n:])**2)), the root, not the mean square"
NOT_OFFICIAL = "the test data are not those of the package: --official"


@dataclass(frozen=True)
class Form:
    """How the package asks for the results of one benchmark.

    Args:
        loader: Function of the package that gives training and test data.
        columns: Of the files that the study reads: time, input, output.
        window: Samples at the start that do not count, as in version 1.0.1.
        unit: Unit of the number.
        factor: From the unit of the data to that.
        objections: Why the number is none to submit, by the package's rules.
    """

    loader: str
    columns: tuple[str, str, str]
    window: int
    unit: str
    factor: float = 1.0
    objections: tuple[str, ...] = ()


FORMS = {
    "cascaded_tanks": Form("Cascaded_Tanks", ("time_s", "pump_V", "level_V"), 50, "V"),
    "emps": Form(
        "EMPS",
        ("time_s", "reference_m", "position_m"),
        20,
        "mm",
        1.0e3,
        (
            "the published study fits blocks of the test record",
            "the loop is simulated closed, from the reference; the package gives the motor force",
        ),
    ),
}


def shared_test(name: str) -> tuple[Array, Array, Array, int]:
    """Time, input and output of the shared recording, and the first sample of the test."""
    folder = data_folder()
    if folder is None:
        raise FileNotFoundError("no data folder found; set DIFFSIM_DATA, or give --official")
    file = {"cascaded_tanks": "estimation.csv", "emps": "steps_second.csv"}[name]
    with (folder / name / file).open() as lines:
        read = np.genfromtxt(lines, delimiter=",", names=True)
    time, given, out = (np.asarray(read[column], float) for column in FORMS[name].columns)
    return time, given, out, 3 * len(out) // 4 if name == "cascaded_tanks" else 0


def official_test(name: str) -> tuple[Array, Array, Array, int]:
    """Time, input and output of the package's test data, which it downloads, and how many samples
    at the start do not count by the package's own rule."""
    import nonlinear_benchmarks

    load = getattr(nonlinear_benchmarks, FORMS[name].loader)
    _, test = load()
    given, out = (np.asarray(x, float) for x in test)
    if name == "emps":  # its input is the motor force; the reference lies in the same file
        from scipy.io import loadmat

        given = loadmat(load(data_file_locations=True)[1])["qg"][:, 0]
    window = int(test.state_initialization_window_length)
    return float(test.sampling_time) * np.arange(len(out)), given, out, window


def simulated(name: str, model: str | Path, time: Array, given: Array, out: Array) -> Array:
    """Free simulation by a saved model; of the output its first sample alone may start it.

    Args:
        name: Benchmark.
        model: Folder or file of the answer.
        time: (num_samples,) [s].
        given: Input, (num_samples,).
        out: Recorded output, (num_samples,); all but the first sample are hidden.
    """
    stated = yaml.safe_load((PUBLISHED / f"{name}.yaml").read_text())
    table = dict(zip(FORMS[name].columns, (time, given, np.full_like(out, out[0])), strict=True))
    hidden = {str(c.get("column", c["name"])) for c in stated["channels"]} - set(table)
    table |= {column: np.zeros_like(out) for column in hidden}
    setup = {"record": "second"} if name == "emps" else {}
    stated["runs"] = [{"name": "test", "file": "test.csv", "use": "test", "setup": setup}]
    stated["data"] = "."
    with tempfile.TemporaryDirectory() as folder:
        write_table(Path(folder) / "test.csv", table)
        (Path(folder) / "study.yaml").write_text(yaml.safe_dump(stated, sort_keys=False))
        study = load_study(Path(folder) / "study.yaml")
    with torch.no_grad():
        made = load_extended(Path(model), study)
        return np.asarray(made.predict(study.runs[0], made.at_prior()).numpy()[:, 0], float)


def write_table(path: Path, table: Mapping[str, Array]) -> None:
    """Write columns of equal length as CSV."""
    with path.open("w", newline="") as lines:
        out = csv.writer(lines)
        out.writerow(table)
        out.writerows(zip(*(column.tolist() for column in table.values()), strict=True))


def score(
    name: str, given: Array, truth: Array, predicted: Array, step: float, window: int | None = None
) -> dict[str, Any]:
    """The number to submit, made by the package's code, with what defines it.

    Args:
        name: Benchmark.
        given: Input, (num_samples,).
        truth: Recorded output, (num_samples,).
        predicted: Simulated output, (num_samples,).
        step: From one sample to the next [s].
        window: Samples at the start that do not count; None: as ``FORMS`` says.
    """
    from nonlinear_benchmarks.error_metrics import RMSE as root_mean_square
    from nonlinear_benchmarks.utilities import Input_output_data

    form = FORMS[name]
    test = Input_output_data(given, truth, sampling_time=step, name=name)
    window = form.window if window is None else window
    test.state_initialization_window_length = window
    found = form.factor * float(root_mean_square(test, predicted))
    return {
        "benchmark": form.loader,
        "metric": "RMSE",
        "value": found,
        "unit": form.unit,
        "formula": RMSE,
        "n": window,
        "mean_square": found**2,
        "mean_square_unit": f"{form.unit}^2",
        "num_samples": len(truth),
    }


def export(name: str, model: str | Path, out: Path, *, official: bool = False) -> dict[str, Any]:
    """Write a benchmark's files and return what ``submission.json`` holds."""
    time, given, truth, start = official_test(name) if official else shared_test(name)
    first, window = (0, start) if official else (start, None)
    predicted = simulated(name, model, time, given, truth)
    kept = slice(first, None)
    step = float(time[1] - time[0])
    found = score(name, given[kept], truth[kept], predicted[kept], step, window)
    found["objections"] = [*FORMS[name].objections, *([] if official else [NOT_OFFICIAL])]
    out.mkdir(parents=True, exist_ok=True)
    columns = {"u": given, "y_test": truth, "y_model": predicted}
    write_table(out / "y_model.csv", {key: value[kept] for key, value in columns.items()})
    save(found, out)
    return found


def export_nano_drone(model: str | Path, out: Path, every: int) -> dict[str, Any]:
    """Write the nano drone's summed errors by the rule of its authors."""
    rows = dict(scores("melon_a", {"ours": Path(model)}, every, is_past_known=False))
    found = {
        "benchmark": "nanodrone-sysid-benchmark (no loader in nonlinear_benchmarks)",
        "metric": "mean length of the error vector, summed over 1 to 50 samples ahead",
        "formula": "sum over h of mean over starts of |y(t + h) - y_model(t + h | t)|",
        "units": ["m", "m/s", "rad", "rad/s"],
        "values": rows["ours"],
        "published_model": rows["published"],
        "every_nth_start": every,
        "objections": ["one test flight of the three", *(["not every start"] if every > 1 else [])],
    }
    out.mkdir(parents=True, exist_ok=True)
    save(found, out)
    return found


def save(found: Mapping[str, Any], out: Path) -> None:
    """Write ``submission.json`` and print it."""
    text = json.dumps(found, indent=2)
    (out / "submission.json").write_text(text + "\n")
    print(text)


def main(
    name: str, model: str, out: Path, *, official: bool = False, every: int = 1
) -> dict[str, Any]:
    """Write the results of one benchmark."""
    if name == "nano_drone":
        return export_nano_drone(model, out, every)
    return export(name, model, out, official=official)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
        parser.add_argument("name", choices=[*FORMS, "nano_drone"])
        parser.add_argument("--model", required=True, help="folder that `diagnose explain` wrote")
        parser.add_argument("--out", type=Path, required=True, help="folder of the results")
        parser.add_argument("--official", action="store_true", help="test data of the package")
        parser.add_argument("--every", type=int, default=1, help="nano drone: each n-th start")
        main(**vars(parser.parse_args()))
