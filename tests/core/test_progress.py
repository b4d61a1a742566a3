"""Progress: bars on a terminal, few plain lines elsewhere, color only where it is wanted."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from diffsim.cli.diagnose_progress import progress_bar as diagnosis_bar
from diffsim.core.progress import Pace, ProgressLines, show_progress

ROOT = Path(__file__).parents[2]
LONGEST = 200  # characters of a line in a log


class Clock:
    """A time that passes only when told."""

    def __init__(self):
        self.now = 50.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def pace(clock):
    return Pace(10.0, clock)


def lines(capsys):
    return capsys.readouterr().err.splitlines()


def test_a_log_of_a_diagnosis_has_a_line_for_each_stage(capsys):
    with diagnosis_bar("diagnose") as show:
        for stage, share in (("plain", 0.0), ("plain", 0.1), ("search", 0.2), ("plain", 0.3)):
            show(stage, share, f"step_1.csv {share}")  # a file keeps its name
    told = [re.sub(r", \d+ s", "", line) for line in lines(capsys)]
    assert [line for line in told if "step" in line] == [
        "diagnose: 0 %, plain step_1.csv 0.0",
        "diagnose: 14 %, search step_1.csv 0.2",
        "diagnose: 100 %, plain step_1.csv 0.3",
    ]


def test_a_line_at_the_start_every_ten_seconds_and_at_the_end(capsys, clock, pace):
    with ProgressLines(desc="simulate", total=400, unit="step", pace=pace) as bar:
        for _ in range(400):
            clock.now += 0.0775
            bar.update()
    assert lines(capsys) == [
        "simulate: step 0 of 400, 0 s",
        "simulate: step 130 of 400, 10 s, 12.9/s",
        "simulate: step 260 of 400, 20 s, 12.9/s",
        "simulate: step 390 of 400, 30 s, 12.9/s",
        "simulate: step 400 of 400, 31 s, 12.9/s",
    ]


def test_bars_share_the_ten_seconds_and_only_those_that_stay_say_their_end(capsys, clock, pace):
    for k in range(30):
        for _ in ProgressLines(range(4), desc=f"part {k}", leave=False, pace=pace):
            clock.now += 0.25
    ends = [f"part {k}: 4 of 4, 1 s, 4/s" for k in (9, 19, 29)]  # after 10, 20 and 30 s
    assert lines(capsys) == ["part 0: 0 of 4, 0 s", *ends]
    for k in range(3):
        with ProgressLines(desc=f"round {k}", pace=pace) as bar:
            clock.now += 1.0
            bar.update(5)
    assert lines(capsys) == [f"round {k}: 5, 1 s, 5/s" for k in range(3)]


def test_a_slow_count_says_the_seconds_of_each_and_what_goes_on(capsys, clock, pace):
    bar = ProgressLines(total=30, initial=10, unit="case", pace=pace)
    clock.now += 5000.0
    bar.update(2)
    clock.now += 10.0
    bar.set_postfix(best=0.123456, worst=123456.7, of="beam")
    bar.set_postfix(refresh=False, best=3)
    clock.now += 10.0
    bar.set_description("sealed")
    clock.now += 10.0
    bar.set_postfix_str("written")
    bar.close()
    bar.close()
    assert lines(capsys) == [
        "case 10 of 30, 0 s",
        "case 12 of 30, 5000 s, 2500 s each",
        "case 12 of 30, 5010 s, 2505 s each, best=0.123, worst=123457, of=beam",
        "sealed: case 12 of 30, 5020 s, 2510 s each, best=3",
        "sealed: case 12 of 30, 5030 s, 2515 s each, written",  # the end says nothing more
    ]


def test_a_share_has_no_rate(capsys, clock, pace):
    with ProgressLines(desc="diagnose", total=100, unit="%", pace=pace) as bar:
        clock.now += 31.0
        bar.n = 40
        bar.set_postfix_str("search friction")
    assert lines(capsys)[-1] == "diagnose: 40 %, 31 s, search friction"


def test_results_stand_between_the_lines_in_the_order_in_which_they_came(tmp_path):
    script = "from diffsim.core.progress import show_progress as s; bar = s(desc='a', total=1); "
    script += "print('one'); bar.write('two'); print('three'); bar.update(); bar.close()"
    said = logged(tmp_path, [sys.executable, "-c", script])
    assert [line.split(",")[0] for line in said] == [
        "a: 0 of 1",
        "one",
        "two",
        "three",
        "a: 1 of 1",
    ]


def test_nothing_is_shown_where_it_is_disabled(capsys):
    assert list(show_progress(range(3), disable=True)) == [0, 1, 2]
    with show_progress(total=2, disable=True) as bar:
        bar.update()
    assert lines(capsys) == []


def test_the_log_of_a_command_is_plain(tmp_path):
    command = [sys.executable, "-m", "diffsim", "devices", "amplifier", "--resolution", "0.25"]
    said = logged(tmp_path, [*command, "--samples", "2", "--evaluations", "2"])
    assert any(line.startswith("random designs: 2 of 2, ") for line in said)
    assert any(line.startswith("loss in the thesis") for line in said)


def logged(folder, command):
    """Lines that a command leaves in a file; none of them meant for a terminal."""
    with open(folder / "log", "wb") as log:
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=True, cwd=ROOT)
    text = (folder / "log").read_bytes().decode()
    assert "\r" not in text and "\x1b" not in text
    assert max(map(len, text.splitlines())) <= LONGEST
    return text.splitlines()


@pytest.mark.parametrize(("no_color", "is_colored"), [("", True), ("1", False)])
def test_a_terminal_has_the_bar_and_no_color_where_none_is_wanted(no_color, is_colored):
    script = "from diffsim.core.progress import show_progress\n"
    script += "for _ in show_progress(range(5), desc='simulate'): pass"
    shown = on_a_terminal(
        [sys.executable, "-c", script], {"TQDM_COLOUR": "green", "NO_COLOR": no_color}
    )
    assert "\rsimulate: 100%|" in shown and "5/5" in shown
    assert (re.search(r"\x1b\[[0-9;]*m", shown) is not None) == is_colored


def on_a_terminal(command, environment):
    """What a command draws on a terminal of 80 columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    plain = {k: v for k, v in os.environ.items() if not k.startswith("TQDM_")}
    process = subprocess.Popen(
        command, stdout=theirs, stderr=theirs, cwd=ROOT, env={**plain, **environment}
    )
    os.close(theirs)
    drawn = b""
    while piece := _read(ours):
        drawn += piece
    os.close(ours)
    assert process.wait() == 0
    return drawn.decode()


def _read(terminal):
    try:
        return os.read(terminal, 4096)
    except OSError:  # Linux says so at its end, others with no bytes
        return b""


def test_only_one_file_draws_bars():
    """Whoever opens a bar or colors text elsewhere would fill logs, and not ask for NO_COLOR."""
    sources = [
        p for d in ("diffsim", "examples", "rl", "benchmarks") for p in ROOT.glob(f"{d}/**/*.py")
    ]
    drawing = re.compile(r"\btqdm\b|import rich|end=['\"]\\r|\\x1b|\\033|progress_bar=True")
    found = {str(p.relative_to(ROOT)) for p in sources if drawing.search(p.read_text("utf-8"))}
    assert found == {"diffsim/core/progress.py"}


def test_a_diagnosis_never_goes_back_is_full_at_the_end_alone_and_ticks(monkeypatch):
    seen: list[int] = []
    bars: list[ProgressLines] = []

    def refresh(bar: ProgressLines) -> None:
        seen.append(bar.n)
        bars.append(bar)

    def ticks() -> bool:
        """Whether it is drawn again though nothing is said meanwhile."""
        drawn = len(seen)
        for _ in range(3000):
            if len(seen) > drawn:
                return True
            time.sleep(0.01)
        return False

    monkeypatch.setattr("diffsim.cli.diagnose_progress.PERIOD_S", 0.01)
    monkeypatch.setattr(ProgressLines, "refresh", refresh)
    with diagnosis_bar("diagnose") as progress:
        assert ticks()
        shown = []
        for share in (0.2, 0.7, 0.1, 1.0):
            progress("search", share, "sets")
            shown.append(bars[-1].n)
        assert shown == [14, 49, 53, 85] and ticks()
        for share in (0.1, 1.0, 0.1, 1.0, 0.1, 1.0, 0.1, 1.0):  # a full one stood at 100 for 60 s
            progress("search", share, "sets")
        assert bars[-1].n == 99
    assert seen == sorted(seen) and seen[-1] == 100


def test_a_notebook_has_one_bar(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ipykernel", object())
    for step in show_progress(range(3), desc="steps", leave=False):
        assert step >= 0
    said = capsys.readouterr().err
    assert "\r" in said and "\n" not in said
    assert all(len(line) <= 80 for line in said.split("\r"))
