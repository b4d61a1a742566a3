"""pytest in forks of a process that has imported what is slow to import, and nothing of diffsim.

A program of its own, for ``planted_errors``: half of a short run of tests is the import of torch.
Its arguments are the modules to import. Each line of its input is a job in JSON: ``tree`` (folder
to run in and import from), ``arguments`` of pytest, ``environment``, ``output`` (file for what is
printed). It answers each by two lines: the process, which leads a session of its own, and how that
ended, with the CPU time of it and of all that it waited for.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from typing import Any


def answer(job: dict[str, Any]) -> None:
    """Run one job in a fork; says who runs it, then how it ended."""
    process = os.fork()
    if process == 0:
        status = 1
        try:
            status = _run(job)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    print(json.dumps({"process": process}), flush=True)
    _, status, usage = os.wait4(process, 0)
    ended = {
        "status": os.waitstatus_to_exitcode(status),
        "cpu_s": usage.ru_utime + usage.ru_stime,
    }
    print(json.dumps(ended), flush=True)


def _run(job: dict[str, Any]) -> int:
    import pytest

    os.setsid()
    output = os.open(job["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.chdir(job["tree"])
    os.environ.clear()
    os.environ.update(job["environment"])
    sys.path.insert(0, job["tree"])
    return int(pytest.main(job["arguments"]))


if __name__ == "__main__":
    sys.path.pop(0)  # the folder of this file
    for name in sys.argv[1:]:
        importlib.import_module(name)
    for line in sys.stdin:
        answer(json.loads(line))
