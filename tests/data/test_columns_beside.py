"""Columns that a study does not mention: what of the files reaches the diagnosis beside it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from diffsim.cli.diagnose_inputs import _study_hash
from diffsim.data import load_study, save_study
from diffsim.data.bank import generated_bank
from diffsim.data.columns_beside import outputs_of
from diffsim.data.study import Column
from diffsim.diagnose.search.fit import cut
from diffsim.systems.multicopter.cutting import evenly_sampled

COUNT = 40
TIME = 0.01 * np.arange(COUNT)
STUDY: dict[str, Any] = {
    "name": "rig",
    "model": {"system": "ode"},
    "time": {"column": "t (s)"},
    "channels": [{"name": "load", "column": "pos (mm)", "unit": "mm", "sd": 0.1}],
    "commands": [{"name": "u", "unit": "N"}],
    "runs": [
        {"name": "a", "file": "a.csv"},
        {"name": "b", "file": "b.csv", "use": "select"},
        {"name": "c", "file": "c.csv", "use": "test"},
    ],
}


def temperature(seed: int) -> np.ndarray:
    return 20.0 + seed + np.cumsum(np.random.default_rng(seed).normal(size=COUNT))


def write(path: Path, columns: dict[str, Any]) -> None:
    cells = [np.broadcast_to(np.asarray(c, object), COUNT) for c in columns.values()]
    rows = zip(*cells, strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, r)) for r in rows)]) + "\n")


def columns_of(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    position = rng.normal(size=COUNT)
    return {
        "t (s)": TIME,
        "pos (mm)": position,
        "u": rng.normal(size=COUNT),
        "temp [degC]": temperature(seed),
    }


@pytest.fixture
def load(tmp_path):
    """A study of three files, with more columns by header: of the run's seed."""

    def of(more=lambda seed: {}, **changes: Any):
        for seed, name in enumerate("abc"):
            write(tmp_path / f"{name}.csv", columns_of(seed) | more(seed))
        (tmp_path / "study.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
        return load_study(tmp_path)

    return of


def test_a_column_that_the_study_does_not_mention_arrives_in_si_units(load):
    study = load()
    assert study.columns == (Column("temp", "K", "temp [degC]"),)
    assert study.left_out == ()
    for seed, run in enumerate(study.runs):
        assert list(run.columns) == ["temp"]
        np.testing.assert_allclose(run.columns["temp"], temperature(seed) + 273.15, rtol=1e-14)


def test_what_the_study_ignores_is_read_by_nothing(load):
    def more(seed: int) -> dict[str, Any]:
        return {"residual_x": temperature(seed + 3), "residual_y": temperature(seed + 6)}

    assert len(load(more).columns) == 3
    study = load(more, ignore=["residual_*"])
    assert [column.name for column in study.columns] == ["temp"]
    assert all(list(run.columns) == ["temp"] for run in study.runs)


def test_windows_and_blocks_cut_it(load):
    window = {"from_s": 0.1, "until_s": 0.3, "every": 2}
    run = load(defaults=window).runs[0]
    whole = temperature(0) + 273.15
    np.testing.assert_allclose(run.columns["temp"], whole[10:30:2], rtol=1e-14)
    run = load(defaults={"every": 4, "average": True}).runs[0]
    np.testing.assert_allclose(run.columns["temp"], whole.reshape(-1, 4).mean(1), rtol=1e-14)
    runs = load(runs=[{"name": "a", "file": "a.csv", "blocks": {"num": 4}}]).runs
    np.testing.assert_allclose(
        [run.columns["temp"] for run in runs], whole.reshape(4, -1), rtol=1e-14
    )


def test_what_tells_nothing_new_is_left_out(load):
    def more(seed: int) -> dict[str, Any]:
        return {
            "supply (V)": 12.0,
            "sample": np.arange(COUNT) + 7,
            "stamp_us": 1e6 * TIME + 1e3 * np.random.default_rng(seed).random(COUNT) + 5e9,
            "uptime": 2.0 * TIME + 100.0 * seed,
            "pos (m)": columns_of(seed)["pos (mm)"] * 1e-3,
            "temp again (K)": temperature(seed) + 273.15,
            "rig": "A",
            "empty_in_one": "" if seed == 1 else TIME**2,
            **({"only_in_one": TIME**2} if seed == 0 else {}),
        }

    study = load(more)
    assert [c.name for c in study.columns] == ["temp"]
    assert all(list(run.columns) == ["temp"] for run in study.runs)
    assert "columns: supply (V) (3 files), sample (3 files)" in study.left_out[0]


def test_a_smooth_warming_is_no_clock_where_its_unit_says_so(load):
    def names(header: str) -> list[str]:
        return [c.name for c in load(lambda seed: {header: 20.0 + 3.0 * seed + TIME}).columns]

    assert names("wall (degC)") == ["temp", "wall"]
    assert names("wall") == names("wall (s)") == ["temp"]


def test_numbers_of_test_runs_do_not_choose(load):
    assert not any(
        c.name == "supply" for c in load(lambda seed: {"supply (V)": 12.0 + (seed == 2)}).columns
    )
    assert any(
        c.name == "supply" for c in load(lambda seed: {"supply (V)": 12.0 + (seed == 1)}).columns
    )


def test_a_missing_cell_lies_on_the_line_between_its_neighbors(load):
    def more(seed: int) -> dict[str, Any]:
        cells = [*(10.0 + TIME**2).tolist()]
        return {"flow (ml/s)": [*cells[:5], "", *cells[6:-1], "nan"]}

    flow = load(more).runs[0].columns["flow"]
    np.testing.assert_allclose(flow[5], 0.5 * (flow[4] + flow[6]), rtol=1e-14)
    np.testing.assert_allclose(flow[7], (10.0 + TIME[7] ** 2) * 1e-6, rtol=1e-12)
    assert flow[-1] == flow[-2]


def test_a_file_of_its_own_is_read_at_the_clock_of_the_run(load, tmp_path):
    slow = {"t (s)": 0.02 * np.arange(COUNT), "humidity (%)": temperature(7)}
    write(tmp_path / "slow.csv", slow)
    study = load(runs=[{"name": "a", "file": ["a.csv", "slow.csv"]}])
    assert [c.name for c in study.columns] == ["temp", "humidity"]
    expected = 0.01 * np.interp(TIME, slow["t (s)"], slow["humidity (%)"])
    np.testing.assert_allclose(study.runs[0].columns["humidity"], expected, rtol=1e-12)


def test_names_can_stand_in_formulas_and_are_free(load):
    def more(seed: int) -> dict[str, Any]:
        noise = np.random.default_rng(10 + seed).normal(size=(4, COUNT))
        return {"load [N]": noise[0], "t": noise[1], "2nd fan": noise[2], "sin": noise[3]}

    study = load(more)
    assert [(c.name, c.unit) for c in study.columns] == [
        ("temp", "K"), ("load_2", "N"), ("t_2", None), ("c_2nd_fan", None), ("sin_2", None)
    ]  # fmt: skip


def test_it_is_saved_and_read_back(load, tmp_path):
    study = load()
    again = load_study(save_study(study, tmp_path / "saved"))
    assert again.columns == (Column("temp", "K", "temp (K)"),)
    for run, other in zip(study.runs, again.runs, strict=True):
        np.testing.assert_array_equal(run.columns["temp"], other.columns["temp"])


def test_whatever_cuts_or_makes_runs_takes_it_along(load):
    study = load()
    run = study.runs[0]
    np.testing.assert_array_equal(cut(run, 0.5).columns["temp"], run.columns["temp"][:20])
    even = evenly_sampled(study, 50.0, [False]).runs[0]
    np.testing.assert_allclose(even.columns["temp"], run.columns["temp"][::2], rtol=1e-14)
    made = generated_bank(study)
    assert made and all(len(run.columns["temp"]) == len(run.time_s) for run in made)


def test_another_reading_is_another_study(load):
    first = _study_hash(load())
    assert first == _study_hash(load())
    assert first != _study_hash(load(lambda seed: {"temp [degC]": temperature(seed + 5)}))


def test_the_row_of_units_below_the_names_is_read(load, tmp_path):
    study = load(lambda seed: {"Speed": temperature(seed + 3)})
    assert study.columns[-1] == Column("Speed", None, "Speed")
    for name in "abc":
        head, *rows = (tmp_path / f"{name}.csv").read_text().splitlines()
        (tmp_path / f"{name}.csv").write_text("\n".join([head, "[s],[mm],[N],,[km/h]", *rows]))
    lay_out = {"header_line": 1, "first_line": 3}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump({**STUDY, "table": lay_out}))
    study = load_study(tmp_path)
    assert study.columns[-1] == Column("Speed", "m/s", "Speed")
    np.testing.assert_allclose(study.runs[0].columns["Speed"], temperature(3) / 3.6, rtol=1e-12)


def test_an_input_that_channels_of_several_units_tell_is_no_output(load):
    """A current tells the voltage, and the thrust beside it the speed of the water."""

    def more(seed: int) -> dict[str, Any]:
        volts, speed = np.random.default_rng(seed).random((2, COUNT))
        return {"amps": volts, "push": volts - 0.3 * speed, "speed": speed, "copy": 1.0 - volts}

    channels = [
        {"name": name, "unit": unit, "sd": 0.1} for name, unit in (("amps", "A"), ("push", "N"))
    ]
    study = load(more, channels=channels)
    assert {"speed", "copy"} <= {column.name for column in study.columns}
    assert outputs_of(study) == {"copy"}
