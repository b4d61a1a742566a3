"""Our Adam is PyTorch's, bit by bit, and does not load PyTorch's compiler."""

import copy
import subprocess
import sys

import pytest
import torch

from diffsim.learn.adam import Adam

BETAS = (0.7, 0.95)


def _parameters() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    shapes = ((4, 3), (4,), ())
    return [
        torch.randn(s, dtype=torch.float64, generator=generator).requires_grad_() for s in shapes
    ]


def _loss(parameters: list[torch.Tensor], k: int) -> torch.Tensor:
    """Its last parameter has no gradient in every third step."""
    weight, bias, single = parameters
    out = (weight.sin().sum(1) * bias).square().sum()
    return out if k % 3 == 2 else out + single.cosh()


@pytest.mark.parametrize("betas", [(0.9, 0.999), BETAS])
def test_steps_are_those_of_pytorch(betas: tuple[float, float]) -> None:
    mine, theirs = _parameters(), _parameters()
    adam = Adam(mine, 0.0, betas)
    reference = torch.optim.Adam(theirs, lr=1.0, betas=betas, foreach=False)
    for k in range(20):
        rate = 0.1 / (1 + k)
        adam.rate = reference.param_groups[0]["lr"] = rate
        for optimizer, parameters in ((adam, mine), (reference, theirs)):
            optimizer.zero_grad()
            _loss(parameters, k).backward()
            optimizer.step()
        for a, b in zip(mine, theirs, strict=True):
            assert torch.equal(a, b), (k, a - b)


def test_a_run_goes_on_from_its_state() -> None:
    whole = _parameters()
    adam = Adam(whole, 0.05, BETAS)
    for k in range(8):
        if k == 4:
            halfway, state = copy.deepcopy(whole), adam.state_dict()
        adam.zero_grad()
        _loss(whole, k).backward()
        adam.step()
    again = Adam(halfway, 0.05, BETAS)
    again.load_state_dict(state)
    for k in range(4, 8):
        again.zero_grad()
        _loss(halfway, k).backward()
        again.step()
    assert all(torch.equal(a, b) for a, b in zip(whole, halfway, strict=True))


def test_a_state_of_pytorch_is_refused() -> None:
    theirs = torch.optim.Adam(_parameters()).state_dict()
    with pytest.raises(ValueError, match="train anew, without --resume"):
        Adam(_parameters(), 0.1).load_state_dict(theirs)


def test_a_learner_is_made_and_steps_without_the_compiler() -> None:
    code = (
        "import sys\nfrom diffsim.learn import GradientLearner, GradientOptions, Setup\n"
        "learner = GradientLearner(Setup('CopterHover'), GradientOptions(batch=2, horizon=2))\n"
        "learner.update(0.0)\n"
        "late = ('torch._dynamo', 'sympy', 'diffsim.systems.registry')\n"
        "print([m for m in late if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[]\n"
