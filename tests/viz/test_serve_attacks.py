"""The index of runs beside files of anybody's: a bad one hides no other and shows nothing else."""

import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
import urllib.error
import urllib.request

import pytest

from diffsim.cli.serve import _viewer
from diffsim.viz.run_folders import run_folders
from tests.optional import needs
from tests.viz.test_run_index import get, served

needs("jinja2", reason="the index of runs needs jinja2")

ROW = '{"reward": 0.5, "steps": 100, "x": [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]}\n'


@pytest.fixture
def runs(tmp_path):
    """One run that can be read."""
    good = tmp_path / "runs" / "good"
    good.mkdir(parents=True)
    (good / "report.json").write_text('{"headline": "Dry friction is missing."}')
    (tmp_path / "runs" / "bad").mkdir()
    return tmp_path / "runs"


BAD = {
    "deep list": ("report.json", "[" * 100_000),
    "deep rows": ("results.jsonl", '{"a":' * 100_000 + "\n"),
    "reward of 400 digits": ("results.jsonl", '{"reward": ' + "9" * 400 + "}\n"),
    "reward of 5,000 digits": ("results.jsonl", '{"reward": ' + "9" * 5000 + "}\n"),
    "steps of another kind": ("results.jsonl", '{"steps": ["x"], "reward": "y"}\n'),
    "half a letter": ("report.json", '{"headline": "\\ud800"}'),
    "no text": ("report.json", b'\xff\xfe{"headline": 1}'),
    "a sentence without end": ("report.json", json.dumps({"headline": "x" * 3_000_000})),
    "no object": ("judge.json", "[1, 2]"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_does_not_take_the_index_down(runs, name):
    file, content = BAD[name]
    data = content if isinstance(content, bytes) else content.encode()
    (runs / "bad" / file).write_bytes(data)
    with served(runs) as base:
        page, _ = get(base + "/")
    assert "Dry friction is missing." in page and page.count("<article") == 2
    assert len(page) < 20_000


def test_names_that_are_no_utf_8(runs):
    folder = os.fsencode(runs) + b"/caf\xe9"
    os.mkdir(folder)
    with open(folder + b"/p\xff.html", "w") as file:
        file.write("<h1>page</h1>")
    with served(runs) as base:
        page, _ = get(base + "/")
        assert "Dry friction is missing." in page and 'href="/caf%E9/p%FF.html"' in page
        for path in ("/%00.html", "/caf%E9/p%FF.html"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                get(base + path)
            assert refused.value.code == 404


def test_files_that_vanish_while_they_are_listed(runs):
    """A run that goes on writes beside and renames."""
    ended = threading.Event()

    def go_on():
        while not ended.is_set():
            for k in range(10):
                folder = runs / f"run_{k}"
                folder.mkdir(exist_ok=True)
                (folder / "new.html").write_text("x")
                os.replace(folder / "new.html", folder / "page.html")
                os.unlink(folder / "page.html")
                folder.rmdir()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        for _ in range(300):
            assert any(run.path == "good" for run in run_folders(runs))
    finally:
        ended.set()
        thread.join()


def test_links_show_nothing_from_outside(runs):
    secret = runs.parent / "report.json"
    secret.write_text('{"headline": "hunter2"}')
    (runs / "bad" / "report.json").symlink_to(secret)
    (runs / "bad" / "results.jsonl").symlink_to(runs / "bad" / "results.jsonl")
    (runs / "elsewhere").symlink_to(runs.parent)
    os.mkfifo(runs / "bad" / "faults.json")  # whoever opens it waits for ever
    (runs / "bad" / "page.html").write_text("")
    found = run_folders(runs)
    assert {run.path for run in found} == {"good", "bad"}
    assert "hunter2" not in str(found)


def test_of_large_results_the_last_rows_are_read(runs, monkeypatch):
    (runs / "bad" / "results.jsonl").write_text(700_000 * ROW)  # 53 MB
    (runs / "good" / "progress.jsonl").write_text(100_000 * ROW)
    read = []
    loads = json.loads
    monkeypatch.setattr(json, "loads", lambda *a, **k: read.append(0) or loads(*a, **k))
    for _ in range(2):
        found = {run.path: run for run in run_folders(runs)}
        assert (found["bad"].said, found["bad"].progress) == ("reward 0.5", "100 steps so far")
        assert len(read) <= 2  # all 700,000 took 5 s; the second visit reads nothing


def test_of_large_reports_the_head_is_read(runs):
    """99 MB of short lists took 17 CPU s and 2.6 GB."""
    lists = ",".join(["[1,2,[3]]"] * 3_000_000)
    path = runs / "bad" / "report.json"
    path.write_text(
        f'{{"headline": "Play \\u00e4 {{", "n": {{"a": [1]}} , "rows": [{lists}], "x": 1}}'
    )
    tracemalloc.start()
    try:
        found = {run.path: run for run in run_folders(runs)}
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found["bad"].said == "Play ä {"
    assert most < 1.5 * path.stat().st_size


def test_two_hundred_clients_at_once_and_half_sent_requests(runs, monkeypatch):
    (runs / "good" / "page.html").write_text("<p>page")
    monkeypatch.setattr("diffsim.viz.run_index._Handler.timeout", 3.0)
    with served(runs) as base:
        address = ("127.0.0.1", int(base.rpartition(":")[2]))
        half = [socket.create_connection(address, timeout=10) for _ in range(100)]
        for client in half:
            client.sendall(b"GET /good/page.html HTTP/1.1\r\nHost: local")
        slow = socket.create_connection(address, timeout=10)
        slow.sendall(b"GET / HTTP/1.1")
        whole = [socket.create_connection(address, timeout=10) for _ in range(200)]
        for client in whole:
            client.sendall(b"GET /good/page.html HTTP/1.1\r\nHost: localhost\r\n\r\n")
        for client in whole:
            answer = b"".join(iter(lambda: client.recv(4096), b""))  # noqa: B023
            assert answer.startswith(b"HTTP/1.0 200") and answer.endswith(b"<p>page")
        given_up = None
        for _ in range(30):  # a letter now and then is not enough
            if given_up := select.select([slow], [], [], 0.2)[0]:
                break
            slow.sendall(b"x")
        assert given_up and slow.recv(4096) == b""
        for client in half:
            assert client.recv(4096) == b""  # given up
        for client in (slow, *half, *whole):
            client.close()


def test_pages_ask_no_other_machine_and_are_what_they_say(runs):
    (runs / "good" / "page.html").write_text("<p>page")
    with served(runs) as base:
        for path in ("/", "/good/page.html"):
            _, headers = get(base + path)
            assert headers["X-Content-Type-Options"] == "nosniff"
            policy = headers["Content-Security-Policy"]
            assert "default-src 'self' 'unsafe-inline' data: blob:;" in policy
            assert "http" not in policy and "*" not in policy


def test_a_download_that_is_given_up_says_nothing(runs, capfd):
    (runs / "good" / "film.rrd").write_bytes(bytes(30_000_000))
    before = threading.active_count()
    with served(runs) as base:
        client = socket.create_connection(("127.0.0.1", int(base.rpartition(":")[2])), timeout=10)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.sendall(b"GET /good/film.rrd HTTP/1.1\r\nHost: localhost\r\n\r\n")
        client.recv(100)
        client.close()  # with a reset
        get(base + "/")
        _wait_until(lambda: threading.active_count() <= before + 1)  # that of the server
    assert capfd.readouterr().err == ""


SERVES = """
import time
from diffsim.cli.serve import _viewer
with _viewer("127.0.0.1"):
    time.sleep(60)
"""


@pytest.mark.parametrize("end", [None, signal.SIGHUP, signal.SIGKILL])
def test_the_viewer_ends_with_the_server(tmp_path, monkeypatch, end):
    """rerun's command starts another process, which ended alone stays with its port open; so it
    does where the server is ended from outside, as by a terminal that is closed."""
    package = tmp_path / "rerun"
    package.mkdir()
    (package / "__init__.py").write_text("")
    child = tmp_path / "child"
    (package / "__main__.py").write_text(
        "import pathlib, subprocess, sys\n"
        "made = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        f"pathlib.Path({str(child)!r}).write_text(str(made.pid))\n"
        "made.wait()\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.getcwd()]))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "rerun", raising=False)
    if end is None:
        with _viewer("127.0.0.1") as address:
            assert address.startswith("http://127.0.0.1:")
            _wait_until(lambda: child.exists() and child.read_text())
    else:
        # tests that run behind nohup ignore SIGHUP, and so would the server
        server = subprocess.Popen(
            [sys.executable, "-c", SERVES],
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
        )
        _wait_until(lambda: child.exists() and child.read_text())
        server.send_signal(end)
        server.wait(timeout=10)
    number = int(child.read_text())
    _wait_until(lambda: not _runs(number))


def _wait_until(holds):
    for _ in range(1000):
        if holds():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come to pass within 10 s")


def _runs(number):
    """Whether a process is there and no zombie, which nobody may have waited for."""
    try:
        with open(f"/proc/{number}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
