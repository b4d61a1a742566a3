"""What a first step imports, which costs seconds; private names of PyTorch are in one file."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import diffsim
from diffsim.core import torch_names

FIRST_STEPS = """
import sys
import torch, numpy
known = set(sys.modules)

def new():
    '''Packages that came in since, but for those of Python itself.'''
    names = {name.partition(".")[0] for name in set(sys.modules) - known}
    return sorted(n for n in names - set(sys.stdlib_module_names) if not n.startswith("_"))

def many():
    return sum(not name.startswith("diffsim") for name in set(sys.modules) - known)

answer = {}
import diffsim.soft
answer["soft, imported"] = new(), many()
from diffsim import mesh, soft
body = soft.SoftBody(mesh.hex_box((2, 1, 1), (0.1, 0.05, 0.05)), dt=0.01,
    youngs_modulus=1e5, poissons_ratio=0.4)
x = body.x_rest.clone().requires_grad_()
soft.step(body, soft.State(x, torch.zeros_like(x))).x.sum().backward()
answer["soft, a step"] = new(), many()
import diffsim.contact, diffsim.stokes, diffsim.ode, diffsim.control, diffsim.linalg
for room in (diffsim.contact, diffsim.stokes, diffsim.ode, diffsim.control, diffsim.linalg):
    for name in room.__all__:
        getattr(room, name)
answer["rooms"] = new(), many()
from diffsim import copter
n = dict(dtype=torch.float64)
vehicle = copter.Multicopter(
    mass=torch.tensor(1.0, **n), inertia=torch.eye(3, **n),
    positions=torch.tensor([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], **n),
    directions=torch.tensor([[0, 0, -1]] * 4, **n), spins=torch.tensor([1, -1, 1, -1], **n),
    torque_ratios=torch.full((4,), 0.02, **n), max_thrusts=torch.full((4,), 8.0, **n),
    radii=torch.full((4,), 0.1, **n))
start = copter.FlightState.at_rest(torch.zeros(1, 3, **n))
thrusts = copter.hover(vehicle).thrusts.detach().requires_grad_()
copter.fly(vehicle, start, thrusts.expand(1, 3, 4), dt=0.01).state.position.sum().backward()
answer["copter, a flight"] = new(), many()
answer["compiler"] = sorted({"torch._dynamo", "torch._inductor", "sympy"} & set(sys.modules))
print(answer)
"""


@pytest.fixture(scope="module")
def imported() -> dict:
    done = subprocess.run([sys.executable, "-c", FIRST_STEPS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return ast.literal_eval(done.stdout)


def test_no_compiler(imported):
    """PyTorch loads it, and sympy with it, for a mark on one function."""
    assert imported["compiler"] == []


@pytest.mark.parametrize(
    ("what", "packages", "count"),
    [
        ("soft, imported", {"diffsim", "numpy"}, 30),
        ("soft, a step", {"diffsim", "numpy"}, 30),
        ("rooms", {"diffsim", "numpy"}, 30),
        ("copter, a flight", {"diffsim", "numpy", "scipy", "yaml"}, 600),
    ],
)
def test_packages(imported, what, packages, count):
    """No package but these, and few modules of others: each costs time at every start."""
    names, modules = imported[what]
    # numpy's f2py, which scipy loads, reads with charset_normalizer where that is installed
    assert set(names) <= packages | {"cython_runtime", "charset_normalizer"}
    assert modules <= count


PRIVATE = re.compile(r"\btorch\._[A-Za-z]|\._C\b|forward_ad\._|_functorch|_opoverload|_backend_fns")


def test_private_names_of_pytorch_stand_in_one_file():
    package = Path(diffsim.__file__).parent
    found = [
        f"{path.relative_to(package)}: {line.strip()}"
        for path in sorted(package.rglob("*.py"))
        if path.name != "torch_names.py"
        for line in path.read_text().splitlines()
        if PRIVATE.search(line)
    ]
    assert not found


def test_the_version_is_the_one_they_were_tried_with():
    """Where it is not: run tests/core and tests/test_transformations.py, then write it down."""
    assert torch.__version__.startswith(torch_names.TRIED + ".")
