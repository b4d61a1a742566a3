"""Python processes for tests, forked from one that has loaded torch, SciPy and diffsim already.

``python("-c", code)`` is ``subprocess.run([sys.executable, "-c", code], capture_output=True,
text=True)`` without the seconds that a new interpreter needs for its imports. The warm process is
started by the first call of a pytest process, has one thread, runs nothing itself, and ends with
the process that started it.

Not for what is read while modules load: what a program imports, Ctrl-C in the meantime, numbers of
threads from the environment, the compiled core that ``DIFFSIM_ISA`` chooses.
"""

import atexit
import contextlib
import gc
import importlib
import io
import json
import os
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

LOADED = (
    "numpy",
    "torch",
    "scipy.optimize",
    "scipy.sparse.linalg",
    "diffsim.cli.main",
    "diffsim.soft",
    "diffsim.copter",
    "diffsim.optim",
)
ROOT = Path(__file__).resolve().parents[1]
ENDED_S = 10.0
"""Wall seconds in which a killed process must be gone."""

COUNT = struct.Struct("<q")
ENDED = struct.Struct("<qd")
"""Exit status and CPU seconds of a process."""

_used_s = 0.0


def used_s() -> float:
    """CPU seconds of all processes that ``python`` ran: no system call counts them for us."""
    return _used_s


def python(
    *words: str,
    cwd: str | os.PathLike[str] | None = None,
    env: Mapping[str, str] | None = None,
    timeout: float | None = None,
    check: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run Python to its end in a process forked from the warm one.

    Args:
        *words: What follows the interpreter: ``"-c", code``, ``"-m", module`` or a script, each
            with its arguments.
        cwd: Folder of the process, this process's own by default.
        env: Its whole environment, this process's own by default. ``PYTHONPATH`` is heeded, other
            variables of the interpreter are not.
        timeout: Wall seconds after which it is killed.
        check: Whether another exit status than 0 raises.

    Raises:
        subprocess.TimeoutExpired: it ran past ``timeout``.
        subprocess.CalledProcessError: it failed, and ``check`` was asked for.
    """
    command = [sys.executable, *words]
    request = {
        "words": words,
        "cwd": os.fspath(cwd or os.getcwd()),
        "env": dict(os.environ if env is None else env),
    }
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        status = _status(json.dumps(request).encode(), [out.fileno(), err.fileno()], timeout)
        said = [_text(file) for file in (out, err)]
    if status is None:
        raise subprocess.TimeoutExpired(command, timeout or 0.0, *said)
    done = subprocess.CompletedProcess(command, status, *said)
    if check:
        done.check_returncode()
    return done


def _status(request: bytes, files: list[int], timeout: float | None) -> int | None:
    """Exit status of a process that was asked for; None where it was killed after ``timeout``."""
    global _used_s
    place = _place()
    socket.send_fds(place, [COUNT.pack(len(request))], files)
    place.sendall(request)
    (pid,) = COUNT.unpack(_received(place, COUNT.size))
    in_time = False
    try:
        in_time = _is_readable(place, timeout)
    finally:  # also where this process is interrupted
        if not in_time:
            os.killpg(pid, signal.SIGKILL)
        status, cpu_s = ENDED.unpack(_received(place, ENDED.size))
        _used_s += cpu_s
    return status if in_time else None


def _is_readable(place: socket.socket, timeout: float | None) -> bool:
    return bool(select.select([place], [], [], timeout)[0])


def _received(place: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = place.recv(size - len(data))
        if not part:
            raise ConnectionError("the other process has ended: see its stderr")
        data += part
    return data


def _text(file: Any) -> str:
    file.seek(0)
    return io.TextIOWrapper(file, encoding="utf-8").read()  # ends of lines as subprocess has them


@cache
def _place() -> socket.socket:
    """Where the warm process of this process takes requests; it is started when first asked for."""
    global _used_s
    mine, its = socket.socketpair()
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *_python_path(os.environ)])}
    for library in ("OMP", "OPENBLAS", "MKL"):
        env[f"{library}_NUM_THREADS"] = "1"  # a pool of threads would not survive the fork
    with its:
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), str(its.fileno())],
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=[its.fileno()],
            start_new_session=True,  # Ctrl-C in a terminal is for pytest
        )
    _used_s += ENDED.unpack(_received(mine, ENDED.size))[1]
    atexit.register(_end, process, mine)
    return mine


def _end(process: subprocess.Popen[bytes], place: socket.socket) -> None:
    place.close()
    process.wait(ENDED_S)


def _python_path(env: Mapping[str, str]) -> list[str]:
    return [part for part in env.get("PYTHONPATH", "").split(os.pathsep) if part]


# What follows runs in the warm process and in those that are forked from it.


def _serve(place: socket.socket) -> dict[str, Any] | None:
    """Fork for each request. Returns what to run in the child, None in the parent at its end."""
    while True:
        head, files, _, _ = socket.recv_fds(place, COUNT.size, 2)
        if not head:
            return None  # who asked has ended
        request = _received(place, *COUNT.unpack(head))
        child = os.fork()
        if child == 0:
            place.close()
            os.setpgid(0, 0)  # so that it is killed with its own children
            for number, file in enumerate(files, start=1):
                os.dup2(file, number)
                os.close(file)
            return json.loads(request)
        for file in files:
            os.close(file)
        with contextlib.suppress(OSError):  # whoever of the two is first
            os.setpgid(child, child)
        place.sendall(COUNT.pack(child))
        _, status, usage = os.wait4(child, 0)
        used = usage.ru_utime + usage.ru_stime
        place.sendall(ENDED.pack(os.waitstatus_to_exitcode(status), used))


def _run(request: dict[str, Any]) -> None:
    """Be the interpreter that was asked for. Errors and exit are left to Python, as it has them."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    first, *rest = request["words"]
    sys.path[:] = [*_python_path(request["env"]), *sys.path]
    if first == "-c":
        code, *arguments = rest
        sys.argv, main = ["-c", *arguments], types.ModuleType("__main__")
        sys.path.insert(0, "")
        sys.modules["__main__"] = main
        exec(compile(code, "<string>", "exec"), vars(main))
    elif first == "-m":
        name, *arguments = rest
        sys.argv = [name, *arguments]
        sys.path.insert(0, os.getcwd())
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    else:
        sys.argv = [first, *rest]
        sys.path.insert(0, str(Path(first).resolve().parent))
        main = types.ModuleType("__main__")
        main.__file__ = first
        sys.modules["__main__"] = main
        exec(compile(Path(first).read_bytes(), first, "exec"), vars(main))


def _without_own_path() -> Iterator[str]:
    """``sys.path`` without this script's folder and without PYTHONPATH."""
    own = {str(Path(__file__).resolve().parent), *_python_path(os.environ)}
    return (part for part in sys.path if part not in own)


def _become_warm() -> socket.socket:
    for name in LOADED:
        importlib.import_module(name)
    sys.path[:] = _without_own_path()
    gc.freeze()
    place = socket.socket(fileno=int(sys.argv[1]))
    place.sendall(ENDED.pack(0, time.process_time()))
    return place


if __name__ == "__main__":
    _own = sys.modules["__main__"]  # kept: its names are needed when another takes its place
    _asked = _serve(_become_warm())
    if _asked is not None:
        _run(_asked)
