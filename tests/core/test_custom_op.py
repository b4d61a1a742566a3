"""Ops of the kernels neither import torch's compiler nor stand in its way."""

import subprocess
import sys

CALL = """
import sys
import torch
from diffsim.core.layer import custom_op

@custom_op("diffsim_test::double")
def double(x: torch.Tensor) -> torch.Tensor:
    return 2.0 * x

@double.register_fake
def _(x):
    return torch.empty_like(x)

double.register_autograd(lambda context, grad: 2.0 * grad)
x = torch.ones(3, dtype=torch.float64, requires_grad=True)
(double(x) ** 2).sum().backward()
assert x.grad.tolist() == [8.0] * 3, x.grad
"""


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_call_with_gradient_does_not_import_the_compiler():
    assert run(CALL + "print('torch._dynamo' in sys.modules, 'sympy' in sys.modules)") == (
        "False False\n"
    )


def test_checks_of_torch_hold():
    """In this process: most of all tests have loaded the compiler, on which torch's checks run."""
    check = "torch.library.opcheck(double, (torch.ones(3, requires_grad=True),))"
    exec(compile(CALL + check, "call", "exec"), {"__name__": "__main__"})


def test_a_study_is_checked_without_what_it_does_not_need(tmp_path):
    """`diffsim diagnose check` of a system of formulas."""
    rows = "".join(f"{0.1 * i:.1f},{i % 7},{i % 5}\n" for i in range(40))
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text("time_s,u,x\n" + rows)
    (tmp_path / "study.yaml").write_text(
        "name: s\nchannels: [{name: x, unit: m, sd: 0.1}]\ncommands: [{name: u, unit: N}]\n"
        "runs: [{name: a, file: a.csv}, {name: b, file: b.csv, use: test}]\n"
        "model: {system: ode, parameters: {k: {value: 1, percent: 5}}, inputs: [u],\n"
        "  states: {y: 0}, rates: {y: u - k*y}, readings: {x: y}}\n"
    )
    out = run(
        "import sys\nfrom diffsim.cli import main\n"
        f"code = main(['diagnose', 'check', {str(tmp_path)!r}])\n"
        "late = ('torch._dynamo', 'scipy.signal', 'scipy.stats', 'sympy', 'pandas', 'cv2')\n"
        "print(code, [m for m in late if m in sys.modules])"
    )
    assert out.splitlines()[-1] == "0 []", out
