"""Processes forked from the warm one end, speak and fail as those of ``subprocess.run`` do."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests import cpu_seconds, warm


@pytest.mark.parametrize(
    "code",
    [
        "print('out'); import sys; print('err', file=sys.stderr)",
        "import sys; sys.exit(3)",
        "import sys; sys.exit('why')",
        "raise SystemExit",
        "import os; os._exit(7)",
        "import os, signal; os.kill(os.getpid(), signal.SIGTERM)",
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
        "import atexit; atexit.register(print, 'late')",
        "import threading, time; threading.Thread(target=lambda: print(time.sleep(0.1))).start()",
        "import os, sys; print(sys.argv, sys.path[0], __name__, os.getcwd(), sys.stdin.read())",
        "print('a\\r\\nb\\rc')",
        "import pickle, sys; Own = type('Own', (), {}); print(pickle.dumps(Own) != b'')",
    ],
)
def test_status_and_words_are_those_of_a_new_interpreter(code, tmp_path):
    asked = ("-c", code, "an argument")
    new = subprocess.run(
        [sys.executable, *asked],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
    )
    done = warm.python(*asked, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (new.returncode, new.stdout, new.stderr)
    assert done.args == new.args


@pytest.mark.parametrize(
    ("code", "status", "last"),
    [
        ("1 / 0", 1, "ZeroDivisionError: division by zero"),
        ("raise KeyboardInterrupt", -signal.SIGINT, "KeyboardInterrupt"),
        ("this is no Python", 1, "SyntaxError: invalid syntax"),
    ],
)
def test_an_error_is_a_traceback(code, status, last):
    done = warm.python("-c", code)
    assert done.returncode == status
    assert done.stderr.startswith(("Traceback", "  File")) and done.stderr.splitlines()[-1] == last
    with pytest.raises(subprocess.CalledProcessError):
        warm.python("-c", code, check=True)


def test_scripts_and_modules_run_by_their_names(tmp_path):
    (tmp_path / "beside.py").write_text("import sys\nprint(__name__, sys.argv[1:])\n")
    (tmp_path / "script.py").write_text("import beside, sys\nprint(__name__, __file__, sys.argv)\n")
    script = str(tmp_path / "script.py")
    done = warm.python(script, "--out", "x", check=True)
    assert done.stdout == f"beside ['--out', 'x']\n__main__ {script} ['{script}', '--out', 'x']\n"
    done = warm.python("-m", "beside", "y", cwd=tmp_path, check=True)
    assert done.stdout == "__main__ ['y']\n"
    with_path = {**os.environ, "PYTHONPATH": str(tmp_path)}
    assert warm.python("-c", "import beside", env=with_path).stdout == "beside []\n"
    assert warm.python("-c", "import beside").returncode == 1


def test_nothing_is_left_for_the_next(monkeypatch):
    first = (
        "import os, sys, torch, diffsim\n"
        "os.environ['LEFT'] = '1'; sys.path.append('/left'); diffsim.left = 1\n"
        "torch.set_num_threads(3); os.chdir('/')\n"
    )
    warm.python("-c", first, check=True)
    second = (
        "import os, sys, torch, diffsim\n"
        "print('LEFT' in os.environ, '/left' in sys.path, hasattr(diffsim, 'left'))\n"
        "print(torch.get_num_threads(), os.getcwd(), os.environ['GIVEN'])\n"
    )
    monkeypatch.setenv("GIVEN", "so")
    done = warm.python("-c", second, check=True)
    assert done.stdout == f"False False False\n1 {os.getcwd()} so\n"
    assert "LEFT" not in os.environ
    assert warm.python("-c", "import os; print(dict(os.environ))", env={}).stdout == "{}\n"


def test_a_process_past_its_time_is_killed_with_its_children(tmp_path):
    code = (
        "import subprocess, sys\n"
        "child = subprocess.Popen(['sleep', '60'])\n"
        "print(child.pid, flush=True)\n"
        "child.wait()\n"
    )
    with pytest.raises(subprocess.TimeoutExpired) as caught:
        warm.python("-c", code, timeout=1.0)
    status = Path(f"/proc/{int(str(caught.value.stdout))}/stat")
    until = time.monotonic() + 10.0
    while status.exists() and " Z " not in status.read_text() and time.monotonic() < until:
        time.sleep(0.01)
    assert not status.exists() or " Z " in status.read_text()  # ended; its parent may not know
    assert warm.python("-c", "print('next')").stdout == "next\n"


def test_it_runs_this_checkout_with_all_loaded_on_one_thread():
    code = (
        "import os, sys, diffsim\n"
        f"assert set({warm.LOADED!r}) <= set(sys.modules)\n"
        "print(diffsim.__file__, len(os.listdir('/proc/self/task')))\n"
    )
    import diffsim

    assert warm.python("-c", code, check=True).stdout == f"{diffsim.__file__} 1\n"


def test_what_it_uses_counts_for_the_test():
    busy = "import time\nwhile time.process_time() < 0.3: pass"
    warm.python("-c", "")
    before = cpu_seconds.used_s()
    warm.python("-c", busy)
    assert 0.25 < cpu_seconds.used_s() - before < 1.0
