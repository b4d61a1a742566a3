"""Damaged and hostile recordings: a reader says so, or reads what it reads without one, in time.

What stands in a damaged file may be read as other numbers where a format has no checksum. Rows may
not vanish without a word, and no reader may hang, take the memory or show another error.
"""

import io
import json
import random
import sqlite3
import zipfile
import zlib

import numpy as np
import pytest

from diffsim.cli import main
from diffsim.data import load_study
from diffsim.data.formats import left_out_of, parts_of, read_columns, write_columns
from tests.data.test_formats import TIME, ulog, write_mcap

DAMAGES = 40
CHECKED = ("mcap", "npz", "xlsx")  # formats whose checksums are held
SILENT = ("mat", "json", "jsonl")  # formats that cannot tell: text and MATLAB's


def mat(folder):
    return write_columns(folder / "log.mat", {"time_s": TIME, "q": TIME})


def hdf5(folder):
    pytest.importorskip("h5py")
    return write_columns(folder / "log.h5", {"time_s": TIME, "q": TIME})


def parquet(folder):
    pytest.importorskip("pyarrow")
    return write_columns(folder / "log.parquet", {"time_s": TIME, "q": TIME})


def npz(folder):
    np.savez(folder / "log.npz", time_s=TIME, q=TIME)
    return folder / "log.npz"


def xlsx(folder):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["time_s", "q"])
    for t in TIME.tolist():
        book.active.append([t, t])
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def json_log(folder):
    (folder / "log.json").write_text(json.dumps([{"time_s": t, "q": t} for t in TIME.tolist()]))
    return folder / "log.json"


def jsonl(folder):
    lines = [json.dumps({"time_s": t, "q": t}) + "\n" for t in TIME.tolist()]
    (folder / "log.jsonl").write_text("".join(lines))
    return folder / "log.jsonl"


def px4(folder):
    pytest.importorskip("pyulog")
    (folder / "log.ulg").write_bytes(ulog(123_000_000))
    return folder / "log.ulg"


def mcap(folder):
    return write_mcap(folder / "log.mcap")


WRITERS = (mat, hdf5, parquet, npz, xlsx, json_log, jsonl, px4, mcap)


def rows_read(path):
    """Rows of all tables of a file; None where it is refused in a sentence."""
    try:
        parts = parts_of(path)
        tables = [read_columns(f"{path}#{part}") for part in parts]
        said = [s for part in parts for s in left_out_of(f"{path}#{part}")]
    except ValueError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)[:200]
        return None
    return sum(len(next(iter(table.values()))) for table in tables), said


@pytest.mark.parametrize("write", WRITERS)
def test_a_damaged_recording_is_refused_or_says_what_it_lost(tmp_path, write, capsys):
    path = write(tmp_path)
    whole, kind = path.read_bytes(), path.suffix[1:]
    rows, said_of_whole = rows_read(path)
    assert rows == 11
    rng = random.Random(0)
    for k in range(DAMAGES):
        damaged = bytearray(whole)
        if k % 2:
            del damaged[rng.randrange(1, len(damaged)) :]
        else:
            for _ in range(3):
                damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        found = rows_read(path)
        if found is None or kind in SILENT:
            continue
        rows, said = found
        cut_between_records = kind == "ulg" and k % 2 and (len(whole) - len(damaged)) % 21 == 0
        assert rows == 11 or said != said_of_whole or cut_between_records, k
        if kind in CHECKED:
            assert rows == 11
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("at", "byte"),
    [
        (0xB8, 0),
        (0xB9, 1),
        (0xB8, 14),
        (145, 8),
        (144, 5),
        (144, 99),
        (152, 14),
        (160, 12),
        (132, 0),
    ],
)
def test_matlab_elements_that_end_scipy_are_refused(tmp_path, at, byte):
    """A kind that is none, an imaginary part that is not there: SciPy's reader crashes."""
    path = mat(tmp_path)
    damaged = bytearray(path.read_bytes())
    damaged[at] = byte
    path.write_bytes(damaged)
    assert rows_read(path) is None


def test_whole_files_of_matlab_pass(tmp_path):
    from scipy.io import savemat
    from scipy.sparse import csc_matrix

    cells = np.empty(3, dtype=object)
    cells[:] = [1.0, "ab", TIME]
    content = {"t": TIME, "z": TIME + 1j, "s": csc_matrix(np.eye(3)), "cells": cells, "no": [],
               "run": {"t": TIME, "sub": {"x": 1}}, "on": TIME > 0.5, "text": "hello"}  # fmt: skip
    for compressed in (False, True):
        savemat(tmp_path / "log.mat", content, do_compression=compressed)
        assert parts_of(tmp_path / "log.mat") == ["", "run"]
        assert set(read_columns(f"{tmp_path}/log.mat#")) == {"t", "on"}


def test_text_that_was_cut_is_refused(tmp_path):
    """In a line of JSON, and in a row of CSV whose cells are too few."""
    for write in (json_log, jsonl):
        path = write(tmp_path)
        path.write_bytes(path.read_bytes()[:-9])
        assert rows_read(path) is None
    (tmp_path / "log.csv").write_text("time_s,q\n0,1\n1,2\n2")
    assert main(["convert", str(tmp_path / "log.csv")]) == 2


def zip_of(name, content):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return out.getvalue()


def header_of(shape, kind="<f8"):
    """A header of NumPy's for an array that is not there."""
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (117 - len(text)) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


HOSTILE = {
    "deep.json": b"[" * 100_000,
    "deep.jsonl": b'{"a":' * 100_000 + b"\n",
    "digits.json": b'[{"time_s": 0, "q": ' + b"9" * 5000 + b"}]",
    "letters.json": b'[{"q": "\xff\xfe"}]',
    "huge.npz": zip_of("q.npy", header_of((10**12,))),
    "negative.npz": zip_of("q.npy", header_of((-5,))),
    "objects.npz": zip_of("q.npy", header_of((1,), "|O") + b"cposix\nsystem\n(S'true'\ntR."),
    "empty.npz": zip_of("q.npy", b""),
    "no.xlsx": zip_of("xl/workbook.xml", b"<workbook/>"),
    "entities.xlsx": zip_of("xl/workbook.xml", b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>"),
    "empty.mat": b"",
    "claim.mat": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"\x0e\0\0\0\xff\xff\xff\x7f",
    "packed.mat": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"\x0f\0\0\0\x20\0\0\0"
    + zlib.compress(bytes(99))[:32],
    "claim.mcap": b"\x89MCAP0\r\n" + b"\x01" + b"\xff" * 8 + b"\x89MCAP0\r\n",
    "short.mcap": b"\x89MCAP0\r\n",
    "empty.ulg": b"",
    "claim.ulg": b"ULog\x01\x12\x35\x01" + bytes(8) + b"\xff\xffF" + b"a" * 100,
    "circle.ulg": ulog(1).replace(b";float[2] control;", b";motors[2] contro;;"),
    "no.h5": b"\x89HDF\r\n\x1a\n" + bytes(500),
    "no.parquet": b"PAR1" + b"\xff" * 40 + b"\xff\xff\xff\x7fPAR1",
    "no.bag": b"#ROSBAG V2.0\n" + b"\xff" * 60,
    "no.db3": b"SQLite format 3\0" + bytes(100),
}  # fmt: skip


NEEDS = {
    "xlsx": "openpyxl", "mcap": "mcap", "ulg": "pyulog", "h5": "h5py", "parquet": "pyarrow",
    "bag": "rosbags", "db3": "rosbags",
}  # fmt: skip


def write_hostile(folder, name):
    if module := NEEDS.get(name.rpartition(".")[2]):
        pytest.importorskip(module)
    (folder / name).write_bytes(HOSTILE[name])
    return folder / name


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_recording_is_refused_in_a_sentence(tmp_path, name, capsys):
    path = write_hostile(tmp_path, name)
    assert main(["convert", str(path)]) == 2
    said = capsys.readouterr().err
    assert name in said and "Traceback" not in said and len(said) < 2_000


def test_groups_that_lead_to_each_other_end(tmp_path):
    """Thirty groups of two ways each: a thousand million paths."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        group = file
        for _ in range(30):
            group["q"] = TIME
            inner = group.create_group("a")
            group["b"] = inner
            group = inner
    with pytest.raises(ValueError, match="stands in two places"):
        parts_of(tmp_path / "log.h5")


def test_arrays_of_other_files_are_left_out_and_said(tmp_path):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "secret").write_bytes(bytes(88))
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time_s"] = TIME
        file["link"] = h5py.ExternalLink("other.h5", "/q")
        file["soft"] = h5py.SoftLink("/time_s")
        file.create_dataset("raw", (11,), "f8", external=[(str(tmp_path / "secret"), 0, 88)])
    assert list(read_columns(tmp_path / "log.h5")) == ["time_s"]
    said = " ".join(left_out_of(tmp_path / "log.h5"))
    assert all(f"{name}: a link, or kept in another file" in said for name in ("link", "raw"))


def test_a_database_without_messages_is_refused(tmp_path):
    pytest.importorskip("rosbags")
    with sqlite3.connect(tmp_path / "log.db3") as base:
        base.execute("create table topics (id integer, name text)")
    with pytest.raises(ValueError, match=r"log\.db3: cannot be read as \.db3"):
        parts_of(tmp_path / "log.db3")


STUDY = """
name: cart
system: rigid_body
channels: [{name: q, unit: m}]
runs: [{name: a, file: "FILE"}]
"""


@pytest.mark.parametrize(
    "cell",
    [
        "1_000",
        "0x1p3",
        "=1+1",
        "1e400",
        "1\0",
        "\u22121",
        "1 2",
        "--1",
        "1.2.3",
        "True",
        "1e",
        "+-1",
    ],
)
def test_what_is_no_number_is_refused_by_row_and_column(tmp_path, cell):
    """Python's own reader takes 1_000 for a thousand."""
    (tmp_path / "log.csv").write_text(f"time_s,q\n0,1\n1,{cell}\n2,3\n", encoding="utf-8")
    (tmp_path / "study.yaml").write_text(STUDY.replace("FILE", "log.csv"))
    with pytest.raises(ValueError, match=r"log\.csv, row 3, column q: .* is not a"):
        load_study(tmp_path)


@pytest.mark.parametrize("name", ["deep.json", "huge.npz", "short.mcap", "empty.ulg", "no.h5"])
def test_a_study_says_which_of_its_files_cannot_be_read(tmp_path, name):
    write_hostile(tmp_path, name)
    (tmp_path / "study.yaml").write_text(STUDY.replace("FILE", name))
    with pytest.raises(ValueError, match=name):
        load_study(tmp_path)


def test_a_flipped_bit_of_a_ulog_costs_its_record_and_is_said(tmp_path):
    """Of every fifth bit: rows may only be fewer where it is said, and refusals are sentences."""
    path = px4(tmp_path)
    whole = path.read_bytes()
    refused = 0
    for place in range(0, 8 * len(whole), 5):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        found = rows_read(path)
        refused += found is None
        assert found is None or found[0] == 11 or found[1], place
    assert refused < 0.2 * 8 * len(whole) / 5
    # the name of its clock: one topic is lost, and said
    damaged = whole.replace(b"uint64_t timestamp", b"uint64_t timestanp")
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match=r"motors: has no timestamp, so its definition is damaged"):
        parts_of(path)
