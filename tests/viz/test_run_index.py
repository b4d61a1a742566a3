"""The index of runs: what each run is and how far, on this machine's own address only."""

import json
import shutil
import subprocess
import threading
import urllib.error
import urllib.request
from contextlib import contextmanager

import pytest

from diffsim.viz.run_folders import run_folders
from diffsim.viz.run_index import make_server
from tests.optional import needs

needs("jinja2", reason="the index of runs needs jinja2")


@pytest.fixture
def runs(tmp_path):
    def write(name, content=""):
        path = tmp_path / "runs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)

    write("cart/report.json", json.dumps({"headline": "Dry friction <b> is missing."}))
    write("cart/inputs.json", "{}")
    write("cart/report.html", "<h1>cart</h1>")
    write("cart/runs.rrd", "rrd")
    write("half/report.json", '{"headline": "not wr')  # being written
    write("shark/results.jsonl", '{"steps": 400, "reward": 0.31}\n{"steps": 800, "rew')
    write("funnel/progress.jsonl", "{}\n{}\n{}\n")
    write("funnel/.hidden.html", "secret")
    write("empty/note.txt", "nothing to show")
    (tmp_path / "outside.html").write_text("secret")
    (tmp_path / "runs" / "cart" / "link.html").symlink_to(tmp_path / "outside.html")
    return tmp_path / "runs"


@contextmanager
def served(root, viewer=None):
    server = make_server(root, 0, viewer)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def get(address, **headers):
    request = urllib.request.Request(address, headers=headers)
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode(), answer.headers


def test_runs_are_told_by_their_files(runs):
    by_path = {run.path: run for run in run_folders(runs)}
    assert set(by_path) == {"cart", "half", "shark", "funnel"}
    assert by_path["cart"].kind == "diagnosis" and by_path["cart"].progress == "finished"
    assert by_path["half"].progress == "going on, or interrupted"
    assert by_path["shark"].progress == "400 steps so far"
    assert by_path["shark"].said == "reward 0.31"
    assert by_path["funnel"].progress == "3 evaluations so far"


def test_judgments_are_told_beside_the_answer_or_alone(runs):
    said = json.dumps({"headline": "The extended model takes the error from 2 to 1 mm."})
    for name in ("cart", "later"):
        (runs / name).mkdir(exist_ok=True)
        (runs / name / "judge.json").write_text(said)
        (runs / name / "judge.html").write_text("<h1>judged</h1>")
    by_path = {run.path: run for run in run_folders(runs)}
    assert by_path["cart"].kind == "diagnosis" and "judge.html" in by_path["cart"].files
    assert by_path["cart"].said.endswith("is missing. Judged: " + json.loads(said)["headline"])
    assert by_path["later"].kind == "judgment"
    assert by_path["later"].said == json.loads(said)["headline"]


def test_a_built_site_is_one_run_and_not_a_run_for_each_folder(runs):
    for name in ("index.html", "404.html", "guide.html", "images/beam.png"):
        path = runs / "docs" / "0.1.0" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    (site,) = (run for run in run_folders(runs) if run.path.startswith("docs"))
    assert (site.path, site.kind, site.files) == ("docs/0.1.0", "site", ("index.html",))


def test_the_page_escapes_what_files_say_and_links_what_there_is(runs):
    with served(runs, viewer="http://127.0.0.1:1") as base:
        page, _ = get(base + "/")
        assert "Dry friction &lt;b&gt; is missing." in page
        assert f"http://127.0.0.1:1/?url={base.replace(':', '%3A').replace('/', '%2F')}" in page
        shown, headers = get(base + "/cart/report.html")
        assert shown == "<h1>cart</h1>"
        assert headers["Access-Control-Allow-Origin"] == "http://127.0.0.1:1"


@pytest.mark.parametrize(
    "path",
    [
        "/cart/link.html",
        "/../outside.html",
        "/%2e%2e/outside.html",
        "/funnel/.hidden.html",
        "/cart/",
        "/nothing.html",
    ],
)
def test_nothing_else_is_served(runs, path):
    with served(runs) as base, pytest.raises(urllib.error.HTTPError) as refused:
        get(base + path)
    assert refused.value.code == 404


def test_another_name_of_this_machine_is_refused(runs):
    with served(runs) as base, pytest.raises(urllib.error.HTTPError) as refused:
        get(base + "/", Host="evil.example")
    assert refused.value.code == 403


def test_it_listens_to_this_machine_only(runs):
    server = make_server(runs, 0)
    try:
        assert server.server_address[0] == "127.0.0.1"
    finally:
        server.server_close()


def test_a_browser_shows_it_without_an_error(runs, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium here")
    log = tmp_path / "log.txt"
    with served(runs) as base, log.open("w") as errors:
        done = subprocess.run(
            [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
             "--dump-dom", f"--user-data-dir={tmp_path / 'profile'}", base + "/"],
            stdout=subprocess.PIPE, stderr=errors, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.stdout.count("<article") == 4
    assert "CONSOLE" not in log.read_text()


def test_a_wrong_folder_is_named(tmp_path, capsys):
    from diffsim import cli

    assert cli.main(["serve", str(tmp_path / "none")]) == 2
    assert "RUNS must be an existing folder" in capsys.readouterr().err


def test_a_flight_says_how_far_it_came_and_an_empty_one_that_it_is(tmp_path):
    tables = {"flown": "time_s,x\n0.0,1\n1.25,2\n", "header": "time_s,x\n", "empty": ""}
    for name, table in tables.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "flight.csv").write_text(table)
    told = {run.path: (run.said, run.progress) for run in run_folders(tmp_path)}
    assert told["flown"] == ("1.25 s flown", "going on, or interrupted")
    assert told["header"] == told["empty"] == ("nothing flown", "no flight")
