"""The command line: arguments reach the demo, errors are one line, Ctrl-C says how to go on."""

import subprocess
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest

from diffsim import __version__, cli
from diffsim.core import compiled, paths
from diffsim.core.errors import ConvergenceError, Mistakes
from diffsim.core.interrupts import EXIT_INTERRUPTED
from tests import warm


@pytest.fixture
def fake_demo(monkeypatch):
    """Stand-in for examples.demo; returns the calls, and raises what ``.error`` holds."""
    module = types.ModuleType("examples.demo")
    record = types.SimpleNamespace(calls=[], error=None)

    def main(**kwargs):
        record.calls.append(kwargs)
        if record.error is not None:
            raise record.error

    module.main = main
    monkeypatch.setitem(sys.modules, "examples.demo", module)
    return record


@pytest.mark.parametrize("debug", [False, True])
def test_warnings_of_arrays_reach_no_user(debug, monkeypatch):
    def main(**kwargs):
        np.log(np.zeros(1))
        np.nanstd(np.full(3, np.nan))
        warnings.warn("forces were limited", RuntimeWarning, stacklevel=1)

    module = types.ModuleType("examples.demo")
    module.main = main
    monkeypatch.setitem(sys.modules, "examples.demo", module)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert cli.main(["demo", *(["--debug"] if debug else [])]) == 0
    assert len(said) == (3 if debug else 1)
    assert "forces were limited" in str(said[-1].message)


def test_demo_receives_every_option(fake_demo, tmp_path):
    argv = ["demo", "--data", str(tmp_path), "--out", "o", "--quick", "--resume", "--threads", "3"]
    assert cli.main([*argv, "--all"]) == 0
    given = {"data": tmp_path, "out": Path("o"), "quick": True, "resume": True, "threads": 3}
    assert fake_demo.calls == [{**given, "anew": True}]


def test_demo_defaults(fake_demo):
    assert cli.main(["demo"]) == 0
    (call,) = fake_demo.calls
    assert call["data"] is None  # the demo then looks in the folders of diffsim.core.paths
    assert call["out"] == Path("runs/demo")
    assert not call["quick"] and not call["resume"] and call["threads"] >= 1


def test_missing_data_folder_is_named(fake_demo, capsys, tmp_path):
    missing = tmp_path / "nowhere"
    assert cli.main(["demo", "--data", str(missing)]) == 2
    assert f"--data must be an existing folder, got {missing}" in capsys.readouterr().err
    assert fake_demo.calls == []


@pytest.mark.parametrize(
    "error",
    [
        ValueError("dt must be\n> 0, got -1"),
        ConvergenceError("stopped", residual_norm=1.0, tolerance=0.1, num_iters=5),
        ImportError("No module named 'rerun'"),
    ],
)
def test_errors_are_one_line_with_status_2(fake_demo, capsys, error):
    fake_demo.error = error
    assert cli.main(["demo"]) == 2
    first, hint = capsys.readouterr().err.splitlines()
    assert first == f"diffsim: {type(error).__name__}: {' '.join(str(error).split())}"
    assert "--debug" in hint


def test_mistakes_that_are_found_together_are_a_line_each(fake_demo, capsys):
    fake_demo.error = Mistakes(["a.csv: no column x", "b.csv:  no column y"])
    assert cli.main(["demo"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == ["diffsim: 2 mistakes:", "    a.csv: no column x", "    b.csv: no column y"]
    fake_demo.error = Mistakes([f"a.csv: no column x{k}" for k in range(9)], most=2)
    assert cli.main(["demo"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "diffsim: 9 mistakes:" and lines[3] == "    ... and 7 more"
    fake_demo.error = Mistakes(["a.csv: no column x"])
    assert cli.main(["demo"]) == 2
    assert capsys.readouterr().err.startswith("diffsim: ValueError: a.csv: no column x\n")


def test_debug_shows_the_traceback(fake_demo):
    fake_demo.error = ValueError("dt must be > 0")
    with pytest.raises(ValueError, match="dt must be > 0"):
        cli.main(["demo", "--debug"])


def test_a_bug_is_not_hidden(fake_demo):
    fake_demo.error = KeyError("bug")
    with pytest.raises(KeyError):
        cli.main(["demo"])


def test_ctrl_c_while_arguments_are_read_ends_in_one_line():
    code = """
import importlib
command = importlib.import_module("diffsim.cli.main")
def parser():
    raise KeyboardInterrupt
command.parser = parser
command.main()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr.strip()) == (EXIT_INTERRUPTED, "interrupted")


def test_interrupt_says_how_to_resume(fake_demo, capsys):
    fake_demo.error = KeyboardInterrupt()
    assert cli.main(["demo", "--out", "my runs", "--quick"]) == 130
    assert "diffsim demo --out 'my runs' --quick --resume" in capsys.readouterr().err
    cli.main(["demo", "--resume"])
    assert "--resume --resume" not in capsys.readouterr().err


def test_threads_must_be_positive(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["demo", "--threads", "0"])
    assert stop.value.code == 2
    assert "must be 1 or more, got 0" in capsys.readouterr().err


def test_info_names_versions_core_and_data(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path / "absent"))
    assert cli.main(["info"]) == 0
    text = capsys.readouterr().out
    assert __version__ in text
    assert compiled.core.instruction_set in text
    assert "set DIFFSIM_DATA" in text and str(tmp_path / "absent") in text


def test_runs_as_a_module():
    done = warm.python("-m", "diffsim", "--version", check=True)
    assert done.stdout.strip() == f"diffsim {__version__}"


def test_a_closed_pipe_is_no_error_message():
    line = f"{sys.executable} -m diffsim info | true"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_what_is_not_there_is_refused_before_a_simulator_is_loaded():
    code = """
import sys
from diffsim import cli
for argv in (["check", "starfsh"], ["faults", "crazypad", "--new", "nowhere.csv"]):
    assert cli.main(["diagnose", *argv]) == 2
sys.exit("torch" in sys.modules or "scipy" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "did you mean 'starfish'" in done.stderr
    assert "nowhere.csv: no such file of a new run" in done.stderr


def test_diagnose_names_a_missing_study(capsys):
    assert cli.main(["diagnose", "check", "nowhere.yaml"]) == 2
    assert (
        "nowhere.yaml: no such study; give study.yaml or the folder that has it"
        in capsys.readouterr().err
    )


def test_a_folder_of_results_does_not_hide_the_published_data_set(tmp_path, monkeypatch):
    from diffsim.cli.arguments import study_file

    monkeypatch.chdir(tmp_path)
    (tmp_path / "starfish").mkdir()  # of `explain starfish --out starfish`
    assert study_file("starfish").parent.name == "published"
    (tmp_path / "starfish" / "study.yaml").touch()
    assert str(study_file("starfish")) == "starfish"


def test_diagnose_check_of_a_good_and_a_bad_study(capsys, tmp_path):
    from dataclasses import replace

    from diffsim.data.study_save import save_study
    from labs.virtual import LABS

    study = LABS["stokes"]()(0)
    path = save_study(study, tmp_path / "good")
    file = path if path.is_file() else path / "study.yaml"
    assert cli.main(["diagnose", "check", str(file)]) == 0
    assert "ready for a diagnosis" in capsys.readouterr().out
    only_choosing = tuple(replace(run, use="select") for run in study.test_runs)
    nothing_fitted = replace(study, runs=only_choosing)
    path = save_study(nothing_fitted, tmp_path / "bad")
    file = path if path.is_file() else path / "study.yaml"
    assert cli.main(["diagnose", "check", str(file)]) == 2
    said = capsys.readouterr()
    assert "no run with use: fit" in said.out and "keep" in said.err


def test_demo_elsewhere_says_where_it_is(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(paths, "SCRIPTS", tmp_path)
    assert cli.main(["demo"]) == 2
    assert "examples.demo is missing" in capsys.readouterr().err


def test_help_of_the_demo_says_what_it_is(capsys):
    with pytest.raises(SystemExit):
        cli.main(["demo", "--help"])
    assert "silicone beam" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["devices", "gate", "--no-slip"], "--no-slip is for the twister"),
        (["devices", "gate", "--export"], "--export needs --out"),
    ],
)
def test_options_of_devices_that_exclude_each_other(argv, message, capsys):
    assert cli.main(argv) == 2
    assert message in capsys.readouterr().err


def test_fit_rotors_needs_data(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path / "absent"))
    assert cli.main(["fit-rotors"]) == 2
    assert "--data" in capsys.readouterr().err


def test_a_stop_by_a_queue_says_how_to_go_on():
    """SIGTERM, as batch systems and services send it, is answered as Ctrl-C is."""
    code = (
        "import os, signal, sys, time\n"
        "from diffsim.cli import diagnose, main\n"
        "def stopped(args):\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    time.sleep(5)\n"
        "diagnose.command = stopped\n"
        "sys.argv = ['diffsim', 'diagnose', 'explain', 'my rig']\n"
        "sys.exit(main())\n"
    )
    done = warm.python("-c", code)
    assert done.returncode == 130
    assert "go on with: diffsim diagnose explain 'my rig'" in done.stderr


def test_an_error_does_not_fill_the_screen_with_what_stands_in_a_file(capsys, tmp_path):
    table = tmp_path / "log.csv"
    table.write_text(f"time_s,q [{'m' * 100_000}]\n0,1\n0.1,2\n")
    (tmp_path / "study.yaml").write_text(
        "name: cart\nsystem: rigid_body\nchannels: [{name: q, unit: m}]\n"
        "runs: [{name: a, file: log.csv}]\n"
    )
    assert cli.main(["diagnose", "check", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "log.csv" in said and "letters more" in said and len(said) < 3_000


@pytest.mark.parametrize(
    "closed",
    [
        *(pytest.param(one, marks=pytest.mark.story) for one in (">&-", "2>&-")),
        "<&- >&- 2>&-",
        "| head -1",
    ],
)
def test_streams_that_are_closed_end_nothing_and_nothing_is_written_elsewhere(tmp_path, closed):
    """Python has None in their place, and the first file that is opened gets their number."""
    (tmp_path / "a.csv").write_text("time_s,q\n0,1\n1,2\n")
    before = (tmp_path / "a.csv").read_text()
    for command in ("info", f"convert {tmp_path}/a.csv {tmp_path}/b.csv", "--help"):
        line = f"{sys.executable} -m diffsim {command} {closed}"
        done = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr, (command, done.stderr)
    assert (tmp_path / "a.csv").read_text() == before
    assert (tmp_path / "b.csv").read_text().split("\n")[1].startswith("0")


def test_too_little_memory_is_a_sentence(fake_demo, capsys):
    fake_demo.error = MemoryError()
    assert cli.main(["demo"]) == 2
    assert capsys.readouterr().err.startswith("diffsim: MemoryError: more memory is needed than")
