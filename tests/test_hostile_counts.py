"""Counts and widths of strangers' files: refused with their key, before anything is made of them.

Each of these took minutes, or all of the memory. What is refused costs a test no time; one that
makes what it is asked for does not end.
"""

import json
import struct
import time
import tracemalloc
import zipfile
import zlib
from typing import Any

import numpy as np
import pytest
import yaml

from diffsim import envs
from diffsim.core.schema import MAX_WHOLE_NUMBER, Part, fill_in
from diffsim.data import load_study
from diffsim.data.formats import columns, parts_of, read_columns
from diffsim.systems.registry import setup_of
from tests.envs.soft_files import finger, with_model

HUGE = 2_000_000_000
ODE = {
    "system": "ode",
    "repeat": {"k": 3},
    "states": {"x_{k}": 0, "v_{k}": 0},
    "parameters": {"c": 1.0},
    "rates": {"x_{k}": "v_{k}", "v_{k}": "-c*x_{k}"},
    "readings": {"q": "x_1"},
}
FORM = {"name": "z", "changes": {"c": "c*(1 + size)"}, "typical": 1, "words": "{:3000000000.2f} N"}


@pytest.fixture
def folder(tmp_path):
    rows = "".join(f"{0.1 * i},{i},7\n" for i in range(50))
    (tmp_path / "a.csv").write_text("time_s,q,n\n" + rows)
    (tmp_path / f"{'x' * 200}.csv").write_text("time_s,q\n0,1\n")
    return tmp_path


def read(folder, **keys: Any):
    run = {"name": "a", "file": "a.csv", **keys.pop("run", {})}
    own = {"name": "c", "channels": [{"name": "q", "unit": "m"}], "runs": [run]}
    (folder / "study.yaml").write_text(yaml.safe_dump({**own, "model": ODE, **keys}))
    study = load_study(folder)
    return setup_of(study), study


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"model": {**ODE, "repeat": {"k": HUGE}}}, "repeat.k must be .* from 1 to 200"),
        ({"run": {"name": "{n:3000000000d}"}}, r"runs\[0\].name: .* no format of up to two digits"),
        ({"run": {"group": "{n:.3000000000f}"}}, r"runs\[0\].group: .* no format"),
        ({"run": {"file": ["a.csv", "b{n:3000000000d}.csv"]}}, r"runs\[0\].file: .* no format"),
        ({"run": {"name": "{file.__class__}"}}, r"runs\[0\].name: .* did you mean 'file'"),
        ({"run": {"file": "{a}{b}{c}{d}{e}{f}{g}{h}{i}{j}z.csv"}}, r"runs\[0\].file: no file fits"),
        ({"run": {"file": "*x" * 50 + ".csv"}}, r"runs\[0\].file: at most 20 words and \*"),
        ({"run": {"blocks": {"num": HUGE}}}, r"runs\[0\].blocks.num: must be at most 10000"),
        ({"run": {"blocks": {"length_s": 1e-12}}}, r"runs\[0\].blocks.length_s: makes 4,900,0"),
        ({"run": {"every": 10**30}}, r"runs\[0\]: every must be at most 1,000,000"),
        ({"table": {"header_line": HUGE}}, r"table\[0\]: header_line must be at most 1,000,000"),
        ({"model": {**ODE, "effects": {"own": [FORM]}}}, r"effects.own\[0\].words: .* no format"),
        ({"model": {**ODE, "parameters": {"c": "1" + " " * 10**5 + "m"}}}, "got 100,002 letters"),
    ],
)  # fmt: skip
def test_a_count_without_end_is_refused_with_its_key(folder, keys, message):
    began = time.process_time()
    with pytest.raises(ValueError, match=message):
        read(folder, **keys)
    assert time.process_time() - began < 4.0  # PyTorch and pint may load meanwhile


def test_counts_of_tasks_are_bounded(tmp_path):
    body = {"bar": {"size": [1, 1, 1], "cells": [5000, 5000, 5000]}}
    (tmp_path / "it.yaml").write_text(yaml.safe_dump(with_model(finger(), body=body)))
    with pytest.raises(ValueError, match=r"cells: at most 1,000,000 cells, got 5000 x 5000 x 5000"):
        envs.make_task(tmp_path / "it.yaml")


def test_every_whole_number_has_a_bound():
    class Inner(Part):
        names: dict[str, tuple[int, ...]] | None = None
        width: float | int | None = None

    Inner(names={"a": (MAX_WHOLE_NUMBER,)}, width=1e30)
    for wrong in ({"names": {"a": (1, MAX_WHOLE_NUMBER + 1)}}, {"width": -HUGE}):
        with pytest.raises(ValueError, match="must be at most 1,000,000, got"):
            Inner(**wrong)


def test_usual_names_and_patterns_are_filled_in(folder):
    (folder / "run_3_fast_7.csv").write_text("time_s,q,n\n0,1,2\n1,2,2\n")
    run = {"file": "run_{a}_{b}_{c}.csv", "name": "{b}-{a}-{c:02d}-{n:.1f}"}
    assert [r.name for r in read(folder, run=run)[1].runs] == ["fast-3-07-2.0"]
    assert fill_in("{{x}} {a:>3} {b:,}", {"a": "q", "b": 12345}) == "{x}   q 12,345"


def test_a_sheet_with_a_cell_in_its_last_corner_is_read(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["time_s", "q"], [0, 1], [1, 2]):
        book.active.append(row)
    book.active["XFD1048576"] = 1
    book.save(tmp_path / "log.xlsx")
    found = read_columns(tmp_path / "log.xlsx")
    np.testing.assert_array_equal(found["q"], [1.0, 2.0])


@pytest.mark.parametrize("row", ["<row><c><v>1</v></c><c><v>2</v></c></row>", "<row/>", "<x:row/>"])
def test_a_small_workbook_of_millions_of_cells_is_refused_at_once(row, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for cells in (["time_s", "q"], [0, 1], [1, 2]):
        book.active.append(cells)
    book.save(tmp_path / "plain.xlsx")
    sheet = "xl/worksheets/sheet1.xml"
    with (
        zipfile.ZipFile(tmp_path / "plain.xlsx") as plain,
        zipfile.ZipFile(tmp_path / "log.xlsx", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in set(plain.namelist()) - {sheet}:
            packed.writestr(name, plain.read(name))
        text = plain.read(sheet).decode()
        head, end = text.split("</sheetData>")
        packed.writestr(sheet, f"{head}{2_000_000 * row}</sheetData>{end}")
    assert (tmp_path / "log.xlsx").stat().st_size < 350_000
    before = time.process_time()
    with pytest.raises(ValueError, match=r"at most 500,000 cells .* save the table as CSV"):
        read_columns(tmp_path / "log.xlsx")
    assert time.process_time() - before < 2.0


def test_ten_thousand_arrays_are_refused_at_once_and_read_where_they_are_many_tables(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["a0"] = np.arange(3.0)
        for k in range(10_000):
            file[f"a{k + 1}"] = file["a0"]
    with pytest.raises(ValueError, match="at most 10,000 entries of a group, '/', got 10,001"):
        parts_of(tmp_path / "log.h5")
    with h5py.File(tmp_path / "demos.h5", "w") as file:
        for k in range(150):
            file[f"data/demo_{k}/q"] = np.arange(3.0)
    began = time.process_time()
    parts = parts_of(tmp_path / "demos.h5")
    assert len(parts) == 150
    for part in parts:
        read_columns(f"{tmp_path}/demos.h5#{part}")
    assert time.process_time() - began < 3.0  # 10 s where each part listed all others


def hdf5_of_a_fill_value(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name in ("time_s", "q"):
            file.create_dataset(name, (HUGE,), "f8", chunks=(10**6,), fillvalue=1.0)


def npz_of_zeros(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("time_s", "q"):
            with archive.open(f"{name}.npy", "w") as entry:
                shape = {"descr": "<f8", "fortran_order": False, "shape": (8 * 10**5,)}
                np.lib.format.write_array_header_1_0(entry, shape)
                for _ in range(80):
                    entry.write(bytes(8 * 10**4))


def mat_of_zeros(path):
    packed = zlib.compressobj(1)
    zeros = struct.pack("<II", 9, 11_000_000)
    parts = [packed.compress(part) for part in (zeros, *[bytes(10**5)] * 110)]
    content = b"".join([*parts, packed.flush()])
    head = b" " * 124 + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + struct.pack("<II", 15, len(content)) + content)


def parquet_of_one_value(path):
    parquet = pytest.importorskip("pyarrow.parquet")
    pyarrow = pytest.importorskip("pyarrow")
    table = pyarrow.table({f"q{k}": np.ones(10**5) for k in range(7)})
    with parquet.ParquetWriter(path, table.schema) as file:
        for _ in range(2):
            file.write_table(table)


def parquet_of_a_long_list(path):
    parquet = pytest.importorskip("pyarrow.parquet")
    pyarrow = pytest.importorskip("pyarrow")
    ends, zeros = pyarrow.array([0, 1_300_000, 1_300_001], "int32"), np.zeros(1_300_001)
    lists = pyarrow.ListArray.from_arrays(ends, pyarrow.array(zeros))
    parquet.write_table(pyarrow.table({"time_s": [0.0, 1.0], "q": lists}), path)


def mcap_with(path, messages, compression="zstd"):
    """Messages of a topic in one chunk.

    Args:
        path: File to be written.
        messages: JSON.
        compression: Of the chunk.
    """
    writer = pytest.importorskip("mcap.writer")
    kind = writer.CompressionType[compression.upper()]
    with path.open("wb") as file:
        log = writer.Writer(file, chunk_size=2**30, compression=kind)
        log.start()
        channel = log.register_channel("t", "json", log.register_schema("s", "jsonschema", b"{}"))
        for k, data in enumerate(messages):
            log.add_message(channel, k * 10**9, data, k)
        log.finish()


def mcap_of_zeros(path):
    mcap_with(path, [b'{"q": 1, "w": "' + bytes(11_000_000).replace(b"\0", b"0") + b'"}'])


def mcap_of_zeros_by_lz4(path):
    mcap_with(path, [b'{"q": ' + b" " * 11_000_000 + b"1}"], "lz4")


@pytest.mark.parametrize(
    ("write", "suffix"),
    [(parquet_of_a_long_list, "parquet"), (mcap_of_zeros, "mcap"), (mcap_of_zeros_by_lz4, "mcap"),
     (hdf5_of_a_fill_value, "h5"), (npz_of_zeros, "npz"), (mat_of_zeros, "mat"),
     (parquet_of_one_value, "parquet")],
)  # fmt: skip
def test_a_small_file_of_many_numbers_is_refused(tmp_path, monkeypatch, write, suffix):
    """An HDF5 file of 3 kB took 32 GB, which ends a process without a word."""
    monkeypatch.setattr(columns, "MOST_UNPACKED", 10**7)  # a hundredth, for the time it takes
    write(tmp_path / f"log.{suffix}")
    tracemalloc.start()
    with pytest.raises(ValueError, match=rf"log.{suffix}: .* it unpacks to"):
        read_columns(tmp_path / f"log.{suffix}")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5e7


LONG = 20_000 * "x"  # in 200 rows an array of 16 MB


def hdf5_of_text(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["time_s"], file["w"] = np.arange(200.0), ["y"] * 199 + [LONG]


def parquet_of_text(path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = {"time_s": np.arange(200.0), "w": ["y"] * 199 + [LONG]}
    parquet.write_table(pytest.importorskip("pyarrow").table(table), path)


def records_of_text(path):
    rows = [{"time_s": k, "w": "y"} for k in range(199)] + [{"time_s": 199, "w": LONG}]
    path.write_text("\n".join(map(json.dumps, rows)))


def mcap_of_text(path):
    words = ["y"] * 10_100 + [LONG[:300]]  # in another block of messages than the first ones
    mcap_with(path, [json.dumps({"w": word}).encode() for word in words])


@pytest.mark.parametrize(
    ("write", "suffix"),
    [(hdf5_of_text, "h5"), (parquet_of_text, "parquet"), (records_of_text, "jsonl"),
     (mcap_of_text, "mcap")],
)  # fmt: skip
def test_one_long_cell_is_refused(tmp_path, monkeypatch, write, suffix):
    """In an array of text each cell takes the room of the longest: 4 MB of JSON took 16 GB."""
    monkeypatch.setattr(columns, "MOST_UNPACKED", 10**7)
    write(tmp_path / f"log.{suffix}")
    with pytest.raises(ValueError, match=r"a text of [0-9,]+ letters in a column of [0-9,]+ rows"):
        read_columns(tmp_path / f"log.{suffix}")


def test_columns_of_parquet_that_are_not_read_may_be_of_any_size(tmp_path, monkeypatch):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(columns, "MOST_UNPACKED", 10**7)
    words = pyarrow.array(["a", None, "b"]).dictionary_encode()
    table = {"time_s": [0.0, 1.0, 2.0], "w": words, "b": [bytes(5_000_000)] * 3}
    parquet.write_table(pyarrow.table(table), tmp_path / "log.parquet")
    found = read_columns(tmp_path / "log.parquet")
    assert {name: found[name].tolist() for name in found} == {
        "time_s": [0.0, 1.0, 2.0],
        "w": ["a", "", "b"],  # not that of another row
    }


def test_wide_records_are_refused(tmp_path):
    (tmp_path / "log.json").write_text(json.dumps([{f"a{k}": 1 for k in range(10_001)}]))
    with pytest.raises(ValueError, match="at most 10,000 columns, got 10,001"):
        read_columns(tmp_path / "log.json")
