"""Loading recordings: every way a file can be wrong has a message that finds the place."""

from pathlib import Path

import numpy as np
import pytest

from labs.markers import Recording, format_csv, load_csv

HEADER = "frame,time_s,tip1_x_m,tip1_y_m,tip1_z_m,base_x_m,base_y_m,base_z_m"


def table(num_frames: int = 30) -> list[str]:
    return [HEADER] + [f"{i},{i / 100},0.1,0.2,{0.3 + i / 1e3},1,2,3" for i in range(num_frames)]


def write(folder: Path, lines: list[str], name: str = "run.csv") -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    return path


def test_reads_places_names_and_times(tmp_path):
    recording = load_csv(write(tmp_path, table()), metadata={"load": 1})
    assert recording.markers == ("tip1", "base")
    assert recording.position_m.shape == (30, 2, 3)
    np.testing.assert_allclose(recording.position_of("tip1")[4], [0.1, 0.2, 0.304])
    assert recording.rate_Hz == pytest.approx(100.0)
    assert recording.is_uniform and recording.num_gaps == 0
    assert recording.name == "run" and recording.metadata == {"load": 1}


def test_empty_cells_and_nan_are_gaps(tmp_path):
    lines = table()
    lines[5] = "4,0.04,,,,1,2,3"
    lines[7] = "6,0.06,0.1,NaN,0.3,1,2,3"
    recording = load_csv(write(tmp_path, lines))
    assert recording.num_gaps == 2
    assert list(np.flatnonzero(recording.is_gap[:, 0])) == [4, 6]
    assert not recording.is_gap[:, 1].any()


def test_round_trip_keeps_micrometers_and_gaps(tmp_path):
    rng = np.random.default_rng(0)
    places = np.round(rng.normal(size=(25, 2, 3)), 6)
    places[3, 1] = np.nan
    made = Recording(np.arange(25) / 120.0, places, ("a", "b"))
    path = tmp_path / "made.csv"
    path.write_text(format_csv(made))
    back = load_csv(path)
    np.testing.assert_array_equal(back.position_m, places)
    np.testing.assert_allclose(back.time_s, made.time_s, atol=5e-7)  # microseconds are kept


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (0, HEADER.replace("time_s", "time"), r"column time_s is missing; column 'time' looks"),
        (0, HEADER.replace("tip1_z_m", "tip1_z_mm"), r"tip1_z_mm is in mm; .* name it tip1_z_m"),
        (0, HEADER.replace("tip1_z_m", "tip1_w_m"), r"column tip1_z_m is missing; did you mean"),
        (0, HEADER.replace("base_x_m", "tip1_x_m"), r"'tip1_x_m' occurs more than once"),
        (4, "3,0.03,0.1,O.2,0.3,1,2,3", r"row 5, column tip1_y_m: 'O.2' is not a number"),
        (4, "3,0.03,0.1,inf,0.3,1,2,3", r"row 5, column tip1_y_m: 'inf' is not a finite"),
        (4, "3,0.03,0.1,250,0.3,1,2,3", r"row 5, column tip1_y_m: 250 m .* millimeters\?"),
        (4, "3,0.02,0.1,0.2,0.3,1,2,3", r"row 5, column time_s: time must increase, got 0.02 s"),
        (4, "3,,0.1,0.2,0.3,1,2,3", r"row 5, column time_s: time is missing"),
        (4, "3,0.03,0.1,0.2,0.3", r"row 5: 5 cells, but the header has 8"),
    ],
)
def test_says_where_the_file_is_wrong(tmp_path, line, text, message):
    lines = table()
    lines[line] = text
    path = write(tmp_path, lines)
    with pytest.raises(ValueError, match=message) as caught:
        load_csv(path)
    assert str(path) in str(caught.value)


def test_refuses_short_empty_and_unseen(tmp_path):
    with pytest.raises(ValueError, match=r"5 frames; a recording needs at least 20"):
        load_csv(write(tmp_path, table(5)))
    with pytest.raises(ValueError, match=r"the file is empty"):
        load_csv(write(tmp_path, []).with_suffix(".csv"))
    unseen = [HEADER] + [f"{i},{i / 100},,,,1,2,3" for i in range(30)]
    with pytest.raises(ValueError, match=r"marker tip1 is never seen"):
        load_csv(write(tmp_path, unseen))
    with pytest.raises(ValueError, match=r"no marker columns"):
        load_csv(write(tmp_path, ["frame,time_s", "0,0", "1,1"]))


def test_missing_file_lists_its_neighbors(tmp_path):
    write(tmp_path, table(), "gravity_a.csv")
    with pytest.raises(FileNotFoundError, match=r"has gravity_a.csv; did you mean 'gravity_a.csv'"):
        load_csv(tmp_path / "gravty_a.csv")


def test_unknown_marker_offers_the_closest(tmp_path):
    recording = load_csv(write(tmp_path, table()))
    with pytest.raises(ValueError, match=r"has no marker 'tip2'; it has tip1, base; did you mean"):
        recording.select(["tip2"])
    with pytest.raises(ValueError, match=r"column tip2_x_m is missing; did you mean 'tip1_x_m'"):
        load_csv(recording.source, markers=["tip2"])
