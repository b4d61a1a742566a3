"""Scripts of users end in one line: after Ctrl-C at any moment, and where a package is missing."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.serial  # interrupts processes

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = [
    path
    for folder in ("examples", "rl")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
]
SECONDS_OF_CLOCK = os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_ctrl_c_is_answered_from_the_first_import_to_the_end(path):
    body = ast.parse(path.read_text(encoding="utf-8")).body
    imports = [n for n in body if isinstance(n, ast.Import | ast.ImportFrom)]
    first = next(n for n in imports if getattr(n, "module", None) != "__future__")
    assert isinstance(first, ast.ImportFrom) and first.module == "diffsim.core.script"
    (main,) = (n for n in body if isinstance(n, ast.If) and "__name__" in ast.dump(n.test))
    assert len(main.body) == 1 and isinstance(main.body[0], ast.With), "all within interruptible()"
    (call,) = (item.context_expr for item in main.body[0].items)
    assert isinstance(call, ast.Call) and call.func.id == "interruptible"


def used_s(process: subprocess.Popen[str]) -> float | None:
    """CPU seconds of a process; None: it ended."""
    try:
        text = Path(f"/proc/{process.pid}/stat").read_text()
    except OSError:
        return None
    return sum(map(int, text.rpartition(")")[2].split()[11:13])) / SECONDS_OF_CLOCK


def hears_ctrl_c() -> None:
    """Shells start jobs in the background deaf to it, and their children inherit that."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    ("script", "after_s"),
    [
        ("examples/softbody/cantilever.py", 0.3),
        ("examples/copter/hexarotor.py", 3.0),
        ("rl/train_gradient.py", 0.8),
        ("-m diffsim fly pentacopter", 0.15),
        ("-m diffsim fly pentacopter", 1.0),
    ],
)
def test_ctrl_c_while_modules_load_and_later(tmp_path, script, after_s):
    words = script.split() if script.startswith("-m") else [str(ROOT / script)]
    process = subprocess.Popen(
        [sys.executable, *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=hears_ctrl_c,
    )
    while (used := used_s(process)) is not None and used < after_s and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode in (130, -signal.SIGINT)  # a shell shows both as 130
    assert "Traceback" not in said and "interrupted" in said, said[-2000:]


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import no_such_package.envs", "no_such_package is not installed: pip install no-such-p"),
        (
            "from diffsim.core.optional import ask_for; ask_for(['no_such'], purpose='this')",
            "this needs no_such, which is not installed: pip install no-such",
        ),
        ("import diffsim.no_such_room", "Traceback"),
        ("from diffsim.core import no_such_name", "Traceback"),
        ("1 / 0", "Traceback"),
    ],
)
def test_a_missing_package_is_named_in_one_line(code, said):
    run = subprocess.run(
        [sys.executable, "-c", f"import diffsim.core.script\n{code}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1
    assert run.stderr.startswith(said), run.stderr
    assert said == "Traceback" or run.stderr.count("\n") == 1
