"""Atomic writes: whole or not at all."""

from __future__ import annotations

import json

import numpy as np
import pytest

from diffsim.core.files import to_plain, write_bytes_atomic, write_json_atomic, write_text_atomic


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
