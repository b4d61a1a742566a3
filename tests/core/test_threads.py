"""Threads that the system refuses, too many of them, forks, and objects that threads share."""

import subprocess
import threading

import numpy as np
import pytest
import scipy.sparse
import torch

from diffsim import copter, linalg, mesh, soft, stokes
from diffsim.core.check import MAX_THREADS
from diffsim.core.threads import one_thread
from tests import warm

TOO_MANY = MAX_THREADS + 1


def run(code: str, seconds: float = 60.0) -> subprocess.CompletedProcess:
    return warm.python("-c", code, timeout=seconds)


def test_threads_that_the_system_refuses_raise():
    """300 stacks of 8 MB do not fit into 3 GB of addresses beside the rest."""
    done = run(
        "import resource, threading, torch\n"
        "from diffsim.linalg import svd3\n"
        "F = torch.eye(3, dtype=torch.float64).expand(200_000, 3, 3)\n"
        "import re\n"
        "used = int(re.search(r'VmSize:\\s+(\\d+)', open('/proc/self/status').read())[1]) * 1024\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 2**29, resource.RLIM_INFINITY))\n"
        "resource.setrlimit(resource.RLIMIT_STACK, (2**23, resource.RLIM_INFINITY))\n"
        "try:\n"
        "    svd3(F, num_threads=300)\n"
        "except RuntimeError as error:\n"
        "    print(error)\n"
        "print(svd3(F, num_threads=2)[1].sum().item())\n"
    )
    assert done.returncode == 0, (done.returncode, done.stderr)
    refused, after = done.stdout.splitlines()
    assert refused.startswith("num_threads is 300, and the system refused to start more than ")
    assert float(after) == 6e5


def test_fits_take_one_thread_of_torch_and_give_it_back():
    before = torch.get_num_threads()
    found: list[int] = []

    @one_thread
    def fit(fails: bool) -> None:
        other = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
        other.start()
        other.join()
        found.append(torch.get_num_threads())
        if fails:
            raise ValueError("no fit")

    try:
        torch.set_num_threads(2)
        fit(False)
        with pytest.raises(ValueError, match="no fit"):
            fit(True)
        assert found == [1, 1, 1, 1] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def eye(n: int) -> torch.Tensor:
    return torch.eye(n, dtype=torch.float64)


@pytest.mark.parametrize(
    "call",
    [
        lambda n: soft.SolverOptions(num_threads=n),
        lambda n: stokes.SolverOptions(num_threads=n),
        lambda n: linalg.svd3(eye(3), num_threads=n),
        lambda n: linalg.SparseCholesky(scipy.sparse.eye(4, format="csr"), num_threads=n),
        lambda n: copter.lqr(eye(2), eye(2), eye(2), eye(2), num_threads=n),
        lambda n: copter.lyapunov(-eye(2), eye(2), num_threads=n),
    ],
)
def test_number_of_threads_is_bounded(call):
    for number in (0, -1, 1.5):
        with pytest.raises(
            (TypeError, ValueError), match=f"num_threads must be a whole number.*got .*{number}"
        ):
            call(number)
    with pytest.raises(ValueError, match=rf"num_threads must lie in \[1, 1024\], got {TOO_MANY}"):
        call(TOO_MANY)
    with pytest.raises(TypeError, match=r"num_threads must be a (whole )?number, got str"):
        call("two")


FORKED = """
import os, signal, torch
{imports}
torch.set_num_threads(2)
big = torch.rand(400, 400, dtype=torch.float64)
(big @ big).exp().sum()  # PyTorch's pool starts
child = os.fork()
if child == 0:
    signal.alarm(20)
    (big @ big).exp().sum()
    os._exit(0)
_, status = os.waitpid(child, 0)
print(os.waitstatus_to_exitcode(status), torch.get_num_threads())
"""


def test_a_forked_process_does_not_wait_for_threads_that_it_does_not_have():
    """PyTorch's pool stays behind in the parent; its child would wait for it for ever."""
    done = run(FORKED.format(imports="import diffsim.soft"))
    assert done.stdout.split() == ["0", "2"], (done.stdout, done.stderr)


def test_statistics_are_those_of_one_thread():
    box = mesh.hex_box((2, 1, 1), (0.1, 0.05, 0.05))
    body = soft.SoftBody(box, dt=0.01, youngs_modulus=1e5, poissons_ratio=0.4)
    still = soft.State(body.x_rest, torch.zeros_like(body.x_rest))
    begun, counts = threading.Barrier(2), {}

    def work(name: str, steps: int) -> None:
        begun.wait()
        with soft.record_stats() as solves:
            for _ in range(steps):
                soft.step(body, still)
            begun.wait()
        counts[name] = len(solves)

    threads = [threading.Thread(target=work, args=(n, k)) for n, k in (("a", 3), ("b", 5))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30.0)
    assert counts == {"a": 3, "b": 5}


def test_one_factor_serves_threads():
    """Each solve has the workspace to itself."""
    n = 60
    line = scipy.sparse.diags([-1.0, 2.1, -1.0], [-1, 0, 1], shape=(n, n))
    grid = scipy.sparse.kronsum(line, line, format="csr")
    factor = linalg.SparseCholesky(grid)
    sides = np.random.default_rng(0).standard_normal((8, n * n))
    expected = [factor.solve(b) for b in sides]
    wrong: list[int] = []

    def work(k: int) -> None:
        for _ in range(150):
            if not np.array_equal(factor.solve(sides[k]), expected[k]):
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert wrong == []
