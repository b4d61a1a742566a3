"""Sealed cylinders: twins in the same file format. Friction grows with the pressure; one swells.

They are easier than the recordings: they go at two speeds and rest at their ends. At one speed
friction over pressure and over speed are hard to tell apart.
"""

from pathlib import Path

import numpy as np
import pytest

from diffsim.data.study import Study
from tests.diagnose.discover.answers import found
from tests.systems.published.twins import load_twin, stated_of, write_table

AREA, NOISE, STROKE = 5.05e-4, 0.5, 0.033  # [m^2], [N], [m]
SPEEDS = 0.008, 0.014  # of the first and the second half [m/s]
REST = 6e-3  # [m]
GROWS = {"o_ring": 0.2, "x_ring_257": 1.4}  # friction over pressure [N/bar]
SWELLS = {"o_ring": 0.0, "x_ring_257": -0.2}  # area over pressure and place [1/(m bar)]
GIVES = 0.4e-3  # a seal yields before it slides [m]


def write_cycles(path: Path, bar: float, label: str, seed: int) -> None:
    """A file of cycles: in and out at two speeds, a pressure that a regulator holds."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 26.0, 0.01)
    speed = np.where(t < 13.0, *SPEEDS)
    turn = STROKE + REST  # beyond its end the spindle stands
    way = np.mod(0.01 * speed.cumsum(), 2.0 * turn)
    stroke = np.clip(turn - np.abs(way - turn), 0.5 * REST, STROKE + 0.5 * REST) - 0.5 * REST
    slip, slips = 0.0, np.zeros_like(t)
    for k, step in enumerate(np.diff(stroke, prepend=0.0)):
        slip += (step - abs(step) * slip) / GIVES
        slips[k] = slip
    friction = 6.0 + GROWS[label] * (bar - 1.0)
    area = AREA * (1.0 + SWELLS[label] * bar * (stroke - 0.017))
    force = area * bar * 1e5 + 1.0 + friction * slips
    columns = {
        "time_s": t,
        "stroke_m": stroke,
        "pressure_Pa": bar * 1e5 + 100.0 * rng.normal(size=len(t)),
        "force_N": force + NOISE * rng.normal(size=len(t)),
    }
    write_table(path, columns)


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Study:
    """The published description of two assemblies at four pressures."""
    folder = tmp_path_factory.mktemp("seals")
    stated = stated_of("pneumatic_actuator")
    for k, bar in enumerate((1, 3, 5, 7)):
        for j, label in enumerate(GROWS):
            write_cycles(folder / f"{label}_{bar}bar.csv", bar, label, 10 * k + j)
    return load_twin(folder, stated | {"runs": stated["runs"][:2]})


@pytest.mark.cpu(12)  # a whole diagnosis of eight recordings
def test_what_pressure_does_is_named_with_its_size_for_each_assembly(study):
    report = found(study)
    assert report.best_names == ("friction_over_pressure", "swelling_over_place"), report.sentences
    for name, sizes, within in (
        ("friction_over_pressure", GROWS, 0.1),
        ("swelling_over_place", SWELLS, 0.02),
    ):
        (row,) = [row for row in report.causes if row.name == name]
        for assembly, label in (("o_ring", "o_ring"), ("x_ring", "x_ring_257")):
            own = row.size[f"[assembly={assembly}]"].value + row.size["all"].value
            assert own == pytest.approx(sizes[label], abs=within)
    assert all(row.after < 0.6 * NOISE for row in report.errors if row.use == "test")
