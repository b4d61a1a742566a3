"""3x3 SVD and polar decomposition: svd3, polar3 and their derivatives."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from diffsim.core import compiled
from diffsim.linalg import _ops_svd
from diffsim.linalg.svd import polar3, svd3
from tests.helpers import check_layer, with_derivatives

# Some 30 roundings of 1.1e-16 in random directions end below 2.5e-15 in the worst of 1e5 matrices;
# 4e-15 leaves room for another compiler's order of operations and still sees one lost digit.
TIGHT = 4e-15
# numpy's own values are off by up to 1.1e-14 s0 where they nearly agree (checked with 40 digits,
# where ours were right to 9e-16).
LAPACK = 3e-14


def rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    q = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def families() -> dict[str, np.ndarray]:
    """Matrices of every kind, 1000 each (not a multiple of a lane pair's 16)."""
    rng = np.random.default_rng(0)
    n = 1000
    graded = 10.0 ** -rng.uniform(0, 20, (n, 3)) * rng.choice([-1, 1], (n, 3))
    repeated = rng.choice([1, 1, -1, 2, 1e-9, -1e-9, 0], (n, 3))
    small = rng.standard_normal((n, 3, 3))
    turned = rotations(rng, n)
    return {
        "random": rng.standard_normal((n, 3, 3)),
        "near_rest": turned @ (np.eye(3) + 1e-2 * small),
        "nearer_rest": turned @ (np.eye(3) + 1e-8 * small),
        "rotation": turned,
        "reflection": -turned,
        "identity": np.tile(np.eye(3), (n, 1, 1)),
        "zero": np.zeros((n, 3, 3)),
        "rank_one": rng.standard_normal((n, 3, 1)) * rng.standard_normal((n, 1, 3)),
        "rank_two": rng.standard_normal((n, 3, 2)) @ rng.standard_normal((n, 2, 3)),
        "graded": (turned * graded[:, None, :]) @ rotations(rng, n),
        "repeated": (turned * repeated[:, None, :]) @ rotations(rng, n),
        "integers": rng.integers(-1, 2, (n, 3, 3)).astype(float),
        "huge": rng.standard_normal((n, 3, 3)) * 1e150,
        "tiny": rng.standard_normal((n, 3, 3)) * 1e-150,
        "largest": rng.uniform(-1, 1, (n, 3, 3)) * 1e307,
        "least": rng.standard_normal((n, 3, 3)) * 1e-305,
    }


FAMILIES = families()


def assert_decomposition(F: np.ndarray) -> None:
    """All that svd3 and polar3 promise, for finite matrices (n, 3, 3)."""
    U, s, V = (t.numpy() for t in svd3(torch.from_numpy(F)))
    R = polar3(torch.from_numpy(F)).numpy()
    scale = np.abs(F).max(axis=(1, 2))
    scale = np.where(scale > 0, scale, 1.0)
    unit_F, unit_s = F / scale[:, None, None], s / scale[:, None]
    for rotation in (U, V, R):
        gram = rotation.transpose(0, 2, 1) @ rotation
        assert np.abs(gram - np.eye(3)).max() < TIGHT
        assert (np.linalg.det(rotation) > 0).all()
    # relative to the largest entry, which s0 exceeds at most threefold
    back = (U * unit_s[:, None, :]) @ V.transpose(0, 2, 1)
    assert np.abs(back - unit_F).max() < 3 * TIGHT
    assert (s[:, 0] >= s[:, 1]).all() and (s[:, 1] >= np.abs(s[:, 2])).all()
    dense = np.linalg.svd(unit_F, compute_uv=False)
    assert np.abs(np.abs(unit_s) - dense).max() < LAPACK
    det = np.linalg.det(unit_F)
    known = np.abs(det) > 1e-13 * dense[:, 0] ** 3  # the sign of a smaller one is rounding
    assert (np.sign(s[known, 2]) == np.sign(det[known])).all()
    # R^T F symmetric and, but for its last eigenvalue, not negative: R is the nearest rotation
    H = R.transpose(0, 2, 1) @ unit_F
    assert np.abs(H - H.transpose(0, 2, 1)).max() < 6 * TIGHT  # 3x for the scale, 2x for the pair
    assert np.abs(np.trace(H, axis1=1, axis2=2) - unit_s.sum(axis=1)).max() < 9 * TIGHT


@pytest.mark.reference
@pytest.mark.parametrize("family", FAMILIES)
def test_against_numpy(family):
    assert_decomposition(FAMILIES[family])


@pytest.mark.property
@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.sampled_from([0.0, 1.0, -1.0, 0.5, 1e-8, 1e-160, 3e-16]), st.floats(-1e3, 1e3)
        ),
        min_size=9,
        max_size=9,
    )
)
@example([1.0, 1.0, 0.0, 0.0, 1e-16, 0.0, 0.0, 0.0, 0.0])
@example([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0])
@example([0.0, 0.0, 0.0, 1e-160, 0.0, 0.0, 0.0, 1.0, 0.0])  # found: s1 came out as -1e-160
@example([5e-324, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
def test_any_matrix(entries):
    assert_decomposition(np.array(entries).reshape(1, 3, 3))


@pytest.mark.property
def test_small_singular_values_keep_absolute_accuracy():
    # known values 1, 1e-9, -1e-12: F^T F alone would lose everything below 1e-8
    rng = np.random.default_rng(1)
    exact = np.array([1.0, 1e-9, -1e-12])
    F = (rotations(rng, 200) * exact) @ rotations(rng, 200)
    s = svd3(torch.from_numpy(F))[1].numpy()
    assert np.abs(s - exact).max() < TIGHT  # forming F costs three roundings more


def test_diagonal_matrix_is_exact():
    F = torch.diag(torch.tensor([1.0, -2.0, 4.0], dtype=torch.float64))
    U, s, V = svd3(F)
    # products of ones, zeros and powers of two: no rounding at all
    assert s.tolist() == [4.0, 2.0, -1.0]
    assert torch.equal(U @ torch.diag(s) @ V.T, F)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nan_stays_in_its_matrix(bad):
    clean = torch.from_numpy(FAMILIES["random"][:40])
    F = clean.clone()
    F[5, 1, 2] = bad
    F[37] = bad
    spoilt = torch.zeros(40, dtype=torch.bool)
    spoilt[[5, 37]] = True
    for got, want in zip((*svd3(F), polar3(F)), (*svd3(clean), polar3(clean)), strict=True):
        assert torch.isnan(got[spoilt]).all()
        assert torch.equal(got[~spoilt], want[~spoilt])  # bit for bit


@pytest.mark.property
def test_a_matrix_does_not_feel_its_neighbors():
    mixed = torch.from_numpy(np.concatenate([f[:3] for f in FAMILIES.values()]))
    for name, function in (("svd3", svd3), ("polar3", lambda F: (polar3(F),))):
        together = function(mixed)
        alone = [function(mixed[i : i + 1]) for i in range(len(mixed))]
        for k, whole in enumerate(together):
            assert torch.equal(whole, torch.cat([a[k] for a in alone])), name


@pytest.mark.property
def test_threads_do_not_change_a_bit():
    F = torch.from_numpy(np.concatenate(list(FAMILIES.values())))
    for one, two in zip(svd3(F, num_threads=1), svd3(F, num_threads=2), strict=True):
        assert torch.equal(one, two)
    assert torch.equal(polar3(F, num_threads=1), polar3(F, num_threads=2))
    grads = []
    for num_threads in (1, 2):
        x = F[:3000].clone().requires_grad_()
        U, s, V = svd3(x, num_threads=num_threads)
        loss = (U * V.cos()).sum() + s.square().sum() + polar3(x, num_threads=num_threads).sum()
        grads.append(torch.autograd.grad(loss, x)[0])
    assert torch.equal(grads[0].nan_to_num(), grads[1].nan_to_num())
    assert grads[0].isfinite().any()


def test_shapes_and_strides():
    empty = torch.empty(0, 3, 3, dtype=torch.float64, requires_grad=True)
    U, s, V = svd3(empty)
    assert U.shape == V.shape == polar3(empty).shape == (0, 3, 3)
    assert s.shape == (0, 3)
    (s.sum() + polar3(empty).sum()).backward()
    assert empty.grad.shape == (0, 3, 3)
    F = torch.from_numpy(FAMILIES["random"][:24]).reshape(2, 3, 4, 3, 3)
    assert svd3(F)[1].shape == (2, 3, 4, 3)
    assert torch.equal(polar3(F)[1, 2, 3], polar3(F[1, 2, 3]))
    turned = F.transpose(-1, -2)
    assert not turned.is_contiguous()
    assert torch.equal(svd3(turned)[1], svd3(turned.contiguous())[1])
    assert torch.equal(polar3(turned), polar3(turned.contiguous()))


def with_values(values: list[list[float]]) -> torch.Tensor:
    """Matrices of given signed singular values, fixed random rotations; requires a gradient."""
    rng = np.random.default_rng(2)
    n = len(values)
    F = (rotations(rng, n) * np.array(values)[:, None, :]) @ rotations(rng, n)
    return torch.from_numpy(F).requires_grad_()


def all_of_svd3(F: torch.Tensor) -> torch.Tensor:
    U, s, V = svd3(F)
    return torch.cat([U.flatten(-2), s, V.flatten(-2)], dim=-1)


@pytest.mark.grad
def test_svd3_layer():
    F = with_values([[3.0, 2.0, 1.0], [1.5, 0.7, -0.4], [2.0, 1.0, 0.0], [1.2, 1.1, 1.0]])
    plain = F.detach()
    check_layer(
        all_of_svd3,
        (F,),
        ops=with_derivatives(_ops_svd.svd3, plain, 1),
    )


@pytest.mark.grad
def test_polar3_layer():
    F = with_values(
        [
            [3.0, 2.0, 1.0],
            [1.0, 1.0, 1.0],
            [2.0, 2.0, 1.0],
            [2.0, 1.0, 1.0],
            [3.0, 2.0, -1.0],  # inverted
            [2.0, 2.0, -1.0],
            [3.0, 2.0, 0.0],
        ]
    )
    plain = F.detach()
    check_layer(
        polar3,
        (F,),
        ops=with_derivatives(_ops_svd.polar3, plain, 1),
    )


@pytest.mark.grad
@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
def test_gradients_scale(scale):
    # R and U do not change with the scale of F, so their gradients go as 1 / scale; s as 1
    x = with_values([[3.0, 2.0, -1.0]])
    y = (x.detach() * scale).requires_grad_()
    weight = torch.linspace(-1, 1, 21, dtype=torch.float64)
    for function, power in ((polar3, 1), (lambda F: svd3(F)[0], 1), (lambda F: svd3(F)[1], 0)):
        unit, scaled = (
            torch.autograd.grad((out.flatten() * weight[: out.numel()]).sum(), F)[0]
            for F in (x, y)
            for out in (function(F),)
        )
        # scale is no power of two: roundings of F and of the product, amplified by s0 / gap = 3
        torch.testing.assert_close(scaled * scale**power, unit, rtol=0, atol=1e-13)


@pytest.mark.grad
@pytest.mark.parametrize("values", [[1.0, 1.0, 1.0], [2.0, 2.0, 1.0], [2.0, 1.0, -1.0]])
def test_svd3_at_the_kink(values):
    """Repeated values: losses of s go through, losses of U or V alone give NaN, not garbage."""
    F = with_values([values])
    _, s, _ = svd3(F)
    (grad,) = torch.autograd.grad(s.square().sum(), F)
    torch.testing.assert_close(
        grad, 2 * F.detach()
    )  # sum s^2 = |F|^2, default 1e-7: any sign error
    loss = (svd3(F)[0] * torch.arange(9, dtype=torch.float64).view(3, 3)).sum()
    (grad,) = torch.autograd.grad(loss, F)
    assert torch.isnan(grad).all()


@pytest.mark.grad
@pytest.mark.parametrize("values", [[2.0, 1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
def test_polar3_at_the_kink(values):
    """s1 + s2 = 0: the nearest rotation is not unique and its derivative is NaN."""
    F = with_values([values])
    R = polar3(F)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(1, dtype=torch.float64))
    weight = torch.tensor([[0.0, 1.0, 2.0], [3.0, 5.0, 4.0], [1.0, 7.0, 9.0]], dtype=torch.float64)
    (grad,) = torch.autograd.grad((R * weight).sum(), F)
    assert torch.isnan(grad).all()
    # a loss that no rotation can change has gradient zero even here
    (grad,) = torch.autograd.grad((0.0 * polar3(F)).sum(), F)
    assert (grad == 0).all()


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_every_build(isa):
    """The core comparison in each build that exists and that this processor can run."""
    if isa not in compiled.available():
        pytest.skip(f"no {isa} build for this processor")
    if isa == compiled.core.instruction_set:  # what all other tests of this file run
        for F in FAMILIES.values():
            assert_decomposition(F)
        return
    here = Path(__file__).parent
    code = (
        "import diffsim.core.compiled as c, test_svd as t\n"
        f"assert c.core.instruction_set == {isa!r}\n"
        "for F in t.FAMILIES.values(): t.assert_decomposition(F)\n"
        "t.test_a_matrix_does_not_feel_its_neighbors()\n"
        "t.test_threads_do_not_change_a_bit()\n"
        "print('held')\n"
    )
    env = {**os.environ, "DIFFSIM_ISA": isa}
    env["PYTHONPATH"] = os.pathsep.join([str(here), str(here.parent), env.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "held"
