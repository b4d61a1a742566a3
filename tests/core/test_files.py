"""Atomic writes: whole or not at all."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest

from diffsim.core.files import (
    append_atomic,
    code_digest,
    csv_text,
    replacing,
    to_plain,
    write_bytes_atomic,
    write_json_atomic,
    write_text_atomic,
)


def test_writes_and_replaces(tmp_path):
    path = write_text_atomic(tmp_path / "new" / "a.txt", "one")
    write_text_atomic(path, "zwei ü")
    assert path.read_text(encoding="utf-8") == "zwei ü"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]
    assert path.stat().st_mode & 0o044  # others may read a report


def test_failure_keeps_the_old_file_and_no_litter(tmp_path, monkeypatch):
    path = write_text_atomic(tmp_path / "a.txt", "old")

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        write_bytes_atomic(path, b"new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_json_is_strict_and_plain(tmp_path):
    value = {"a": np.arange(3), "b": np.float64(0.5), "c": float("nan"), 4: (True, None, tmp_path)}
    path = write_json_atomic(tmp_path / "a.json", value)
    back = json.loads(path.read_text(), parse_constant=lambda _: pytest.fail("not strict JSON"))
    assert back == {"a": [0, 1, 2], "b": 0.5, "c": None, "4": [True, None, str(tmp_path)]}
    with pytest.raises(TypeError, match=r"cannot write set to JSON"):
        to_plain({1, 2})


def full_disk(*_, **__) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_names_the_file_and_leaves_no_half(tmp_path, monkeypatch):
    path = write_text_atomic(tmp_path / "result.txt", "old")
    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match=r"No space left on device: '.*/result.txt'") as caught:
        write_bytes_atomic(path, b"new")
    assert caught.value.errno == errno.ENOSPC and caught.value.filename == str(path)
    with pytest.raises(OSError, match=r"No space left on device: '.*/result.txt'"):
        append_atomic(path, b" and more")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["result.txt"]


def test_errors_of_writers_name_the_file_too(tmp_path, monkeypatch):
    path = tmp_path / "table.h5"
    failed = r"cannot write .*table.h5: file write failed"
    with pytest.raises(OSError, match=failed), replacing(path) as beside:
        beside.write_text("half")
        raise OSError("file write failed")  # a library's own, without a number
    with pytest.raises(FileNotFoundError, match=r"'other\.csv'"), replacing(path):
        raise FileNotFoundError(errno.ENOENT, "No such file", "other.csv")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr("tempfile.mkstemp", full_disk)
    with pytest.raises(OSError, match=r"No space left on device: '.*table.h5'"):
        write_text_atomic(path, "new")


def test_a_disk_that_takes_a_part_keeps_what_was_there(tmp_path, monkeypatch):
    """A raw write that is cut off raises nothing; the next one does."""
    path = write_text_atomic(tmp_path / "log.jsonl", "first\n")
    append_atomic(path, b"second\n")
    opened = Path.open

    class Nearly:
        """A file on a disk with room for three more bytes."""

        def __init__(self, file):
            self.file, self.room = file, 3

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.file.close()

        def write(self, data):
            if not self.room:
                full_disk()
            taken = self.file.write(data[: self.room])
            self.room -= taken
            return taken

        def __getattr__(self, name):
            return getattr(self.file, name)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda *args, **kw: Nearly(opened(*args, **kw)))
        with pytest.raises(OSError, match=r"No space left on device: '.*log.jsonl'"):
            append_atomic(path, b"third\n")
    assert path.read_text() == "first\nsecond\n"


def test_digest_of_code_sees_every_byte_of_what_computes(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"1")
    before = [code_digest(), code_digest(tmp_path)]
    assert before[0] != before[1]
    path.write_bytes(b"2")
    code_digest.cache_clear()
    assert code_digest() == before[0]
    assert code_digest(tmp_path) != before[1]
    (tmp_path / "notes.txt").write_bytes(b"nothing is computed from it")
    two = code_digest(tmp_path)
    code_digest.cache_clear()
    assert code_digest(tmp_path) == two


def test_a_table_reads_back_as_it_was():
    rows = [(1, 0.1 + 0.2, "a,b"), (2, float("nan"), ""), (3, np.float64(-0.0), True)]
    lines = csv_text(["n", "x, in m", "word"], rows).splitlines()
    assert lines[0] == 'n,"x, in m",word'
    assert lines[1:] == ['1,0.30000000000000004,"a,b"', "2,,", "3,-0.0,True"]
    assert csv_text(["x"], [[0.1 + 0.2], [7]], ".3g") == "x\n0.3\n7\n"
