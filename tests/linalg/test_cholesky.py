"""Sparse Cholesky: against dense and other sparse solvers, and what it must refuse."""

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from diffsim.core.errors import FactorizationError
from diffsim.linalg import SparseCholesky

# Cholesky with rounding is backward stable: |A x - b| <= c n eps |A| |x| with small c; for the
# sizes here (row sums over <= 1e4 entries) 1e-13 leaves a factor of about 100 over what is seen.
BACKWARD = 1e-13


def grid_graph(*shape):
    """27-point (hexahedral mesh) pattern of a grid, and its coordinates."""
    axes = [sp.diags([np.ones(n - 1), np.ones(n), np.ones(n - 1)], [-1, 0, 1]) for n in shape]
    pattern = sp.kron(sp.kron(axes[0], axes[1]), axes[2]).tocsr()
    coords = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    return pattern, coords.astype(float)


def tet_graph(num_nodes, seed=0):
    """Pattern of a Delaunay mesh of random points, and its coordinates."""
    coords = np.random.default_rng(seed).random((num_nodes, 3)) * [3.0, 1.0, 1.0]
    tets = Delaunay(coords).simplices
    rows = np.repeat(tets, 4, axis=1).ravel()
    cols = np.tile(tets, (1, 4)).ravel()
    return sp.csr_matrix((np.ones(len(rows)), (rows, cols)), shape=(num_nodes, num_nodes)), coords


def laplacian(pattern, shift=0.0, block=1, seed=0):
    """Sum over edges of w (e_i - e_j)(e_i - e_j)' (x) B B' + shift I: definite where shift > 0."""
    rng = np.random.default_rng(seed)
    edges = sp.triu(pattern, 1).tocoo()
    num, n = edges.nnz, pattern.shape[0]
    data, cols = [], []
    for _ in range(block):
        direction = rng.standard_normal((num, block)) if block > 1 else rng.random((num, 1)) + 0.5
        data.append(np.concatenate([direction, -direction], axis=1))
        cols.append(
            np.concatenate(
                [ends[:, None] * block + np.arange(block) for ends in (edges.row, edges.col)],
                axis=1,
            )
        )
    rows = np.repeat(np.arange(num * block), 2 * block)
    difference = sp.csr_matrix(
        (np.concatenate(data).ravel(), (rows, np.concatenate(cols).ravel())),
        shape=(num * block, n * block),
    )
    matrix = (difference.T @ difference).tocsr()
    return (matrix + shift * sp.identity(n * block)).tocsr()


def backward_error(matrix, x, b):
    x, b = x.reshape(len(x), -1), b.reshape(len(b), -1)
    norm = abs(matrix).sum(axis=1).max()
    return (np.abs(matrix @ x - b).max(0) / (norm * np.abs(x).max(0) + 1e-300)).max()


GRAPHS = {
    "grid": lambda: grid_graph(9, 6, 5),
    "bar": lambda: grid_graph(200, 2, 1),
    "tets": lambda: tet_graph(700),
    "point": lambda: (sp.identity(1, format="csr"), np.zeros((1, 3))),
    "isolated": lambda: (sp.identity(300, format="csr"), np.zeros((300, 3))),
    "two bodies": lambda: (
        sp.block_diag([tet_graph(150)[0], grid_graph(5, 5, 5)[0]], format="csr"),
        np.concatenate([tet_graph(150)[1], grid_graph(5, 5, 5)[1]]),
    ),
    "coincident": lambda: (tet_graph(300)[0], np.zeros((300, 3))),
    "hub": lambda: (
        sp.csr_matrix(sp.bmat([[sp.identity(400), np.ones((400, 1))], [np.ones((1, 400)), [[1]]]])),
        np.random.default_rng(2).random((401, 3)),
    ),
    "dense": lambda: (sp.csr_matrix(np.ones((150, 150))), np.arange(450.0).reshape(150, 3)),
}


@pytest.mark.reference
@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("block", [1, 3])
@pytest.mark.parametrize("with_coords", [True, False])
def test_matches_spsolve(name, block, with_coords):
    pattern, coords = GRAPHS[name]()
    matrix = laplacian(pattern, shift=0.5, block=block)
    n = matrix.shape[0]
    b = np.random.default_rng(1).standard_normal((n, 3))
    factor = SparseCholesky(matrix, coords if with_coords else None, block=block)
    x = factor.solve(b)
    assert backward_error(matrix, x, b) < BACKWARD
    expected = spla.spsolve(matrix.tocsc(), b).reshape(n, 3)
    # Condition number below 1e4 (shift 0.5, row sums below 5e3): 1e4 * 1e-14 for each solver.
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.reference
@pytest.mark.parametrize("num_rhs", [1, 2, 3, 4, 5, 6, 7, 12])
@pytest.mark.parametrize("block", [1, 2, 3])
def test_any_number_of_right_hand_sides_against_dense(num_rhs, block):
    pattern, coords = tet_graph(150)
    matrix = laplacian(pattern, shift=1.0, block=block)
    b = np.random.default_rng(3).standard_normal((matrix.shape[0], num_rhs))
    x = SparseCholesky(matrix, coords, block=block).solve(b)
    expected = np.linalg.solve(matrix.toarray(), b)
    # Condition number about 1e3, both solvers backward stable: 1e3 * 1e-14.
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.property
@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 220),
    density=st.floats(0.0, 0.3),
    block=st.integers(1, 4),
    seed=st.integers(0, 2**31),
)
def test_random_matrices(n, density, block, seed):
    rng = np.random.default_rng(seed)
    pattern = sp.random(n, n, density, random_state=rng, format="csr")
    pattern = (pattern + pattern.T + sp.identity(n)).tocsr()
    matrix = laplacian(pattern, shift=0.1, block=block, seed=seed)
    b = rng.standard_normal(n * block)
    x = SparseCholesky(matrix, block=block).solve(b)
    assert x.shape == b.shape
    assert backward_error(matrix, x, b) < BACKWARD


@pytest.mark.property
@pytest.mark.parametrize("block", [1, 3])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_threads_change_no_bit(block, precision):
    pattern, coords = tet_graph(3000)
    matrix = laplacian(pattern, shift=0.1, block=block)
    b = np.random.default_rng(4).standard_normal((matrix.shape[0], 7))
    one, two, five = (
        SparseCholesky(matrix, coords, block=block, precision=precision, num_threads=k).solve(b)
        for k in (1, 2, 5)
    )
    assert np.array_equal(one, two)
    assert np.array_equal(one, five)


@pytest.mark.property
def test_right_hand_sides_do_not_mix():
    pattern, coords = tet_graph(400)
    factor = SparseCholesky(laplacian(pattern, shift=0.1), coords)
    b = np.random.default_rng(5).standard_normal((400, 8))
    together = factor.solve(b)
    apart = np.stack([factor.solve(np.ascontiguousarray(column)) for column in b.T], axis=1)
    # Groups of columns may sum in another order: condition number 1e4 times eps.
    np.testing.assert_allclose(together, apart, rtol=0, atol=1e-11 * np.abs(apart).max())


@pytest.mark.property
@pytest.mark.parametrize("precision, error", [("float64", 1e-11), ("float32", 3e-5)])
def test_the_inverse_between_a_few_unknowns(precision, error):
    pattern, coords = grid_graph(11, 9, 8)
    A = laplacian(pattern, shift=0.1, block=3)
    factor = SparseCholesky(A, coords=coords, block=3, precision=precision)
    nodes = np.flatnonzero((coords[:, 2] == 0.0) & (coords[:, 0] < 4.0))  # of one corner of a face
    among = (3 * nodes[:, None] + np.arange(3)).reshape(-1)[::-1][:-2].copy()
    columns = np.zeros((A.shape[0], len(among)))
    columns[among, np.arange(len(among))] = 1.0
    exact = spla.spsolve(A.tocsc(), columns)[among]
    found = [factor._factor.inverse_among(torch.from_numpy(among), k).numpy() for k in (1, 2)]
    np.testing.assert_array_equal(*found)
    np.testing.assert_array_equal(found[0], found[0].T)
    # eps times a condition of about 1e4, and a tenth of it in single precision
    np.testing.assert_allclose(found[0], exact, rtol=0, atol=error * np.abs(exact).max())


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_refactor_equals_a_new_factor(precision):
    pattern, coords = grid_graph(8, 7, 6)
    first, second = (laplacian(pattern, shift=0.3, seed=s) for s in (0, 1))
    b = np.random.default_rng(6).standard_normal(first.shape[0])
    factor = SparseCholesky(first, coords, precision=precision)
    before = factor.solve(b)
    factor.refactor(second)
    assert np.array_equal(
        factor.solve(b), SparseCholesky(second, coords, precision=precision).solve(b)
    )
    factor.refactor(first)
    assert np.array_equal(factor.solve(b), before)


@pytest.mark.property
@pytest.mark.parametrize("block", [1, 3])
def test_ill_conditioned_is_still_backward_stable(block):
    """Condition number 1e12 twice over: a nearly free body, and columns scaled over 1e12."""
    pattern, coords = tet_graph(600 // block)
    stiff = laplacian(pattern, block=block)
    free = stiff + 1e-10 * sp.identity(stiff.shape[0])
    scale = sp.diags(10.0 ** np.random.default_rng(7).uniform(-6, 0, stiff.shape[0]))
    scaled = (scale @ (stiff + 0.1 * sp.identity(stiff.shape[0])) @ scale).tocsr()
    for matrix in (free.tocsr(), scaled):
        assert np.linalg.cond(matrix.toarray()) > 1e11
        x_known = np.random.default_rng(8).standard_normal((matrix.shape[0], 3))
        for b in (matrix @ x_known, x_known):  # with a small and with a huge solution
            x = SparseCholesky(matrix, coords, block=block).solve(b)
            assert backward_error(matrix, x, b) < BACKWARD


@pytest.mark.property
def test_float32_storage_is_a_preconditioner():
    pattern, coords = grid_graph(10, 8, 8)
    matrix = laplacian(pattern, shift=0.5)
    b = np.random.default_rng(9).standard_normal((matrix.shape[0], 3))
    double = SparseCholesky(matrix, coords)
    single = SparseCholesky(matrix, coords, precision="float32")
    assert single.num_bytes * 2 == double.num_bytes
    error = np.abs(single.solve(b) - double.solve(b)).max() / np.abs(double.solve(b)).max()
    # float32 eps 6e-8 times a condition number of about 1e3 at most; not exact, or L is float64.
    assert 1e-10 < error < 6e-5


def test_where_float32_breaks_down_float64_computes_the_factor():
    """The last pivot is the shift times the number of nodes: less than single precision tells."""
    pattern, coords = grid_graph(8, 7, 6)
    matrix = laplacian(pattern, shift=1e-8)
    factor = SparseCholesky(matrix, coords, precision="float32")
    b = np.random.default_rng(10).standard_normal(matrix.shape[0])
    preconditioner = spla.LinearOperator(matrix.shape, factor.solve, dtype=float)
    x, failed = spla.cg(matrix, b, rtol=1e-8, maxiter=5, M=preconditioner)
    assert not failed
    assert np.abs(matrix @ x - b).max() < 1e-6 * np.abs(b).max()


def test_fill_is_that_of_nested_dissection():
    """Band order stores about 17^2 entries a column of this cube; dissection about half."""
    pattern, coords = grid_graph(17, 17, 17)
    matrix = laplacian(pattern, shift=1.0)
    assert SparseCholesky(matrix, coords).nnz < 0.65 * 17**5
    assert SparseCholesky(matrix).nnz < 0.7 * 17**5


@pytest.mark.filterwarnings("ignore:Sparse")
def test_tensors_and_torch_csr():
    pattern, coords = tet_graph(60)
    matrix = laplacian(pattern, shift=1.0)
    as_torch = torch.sparse_csr_tensor(
        torch.as_tensor(matrix.indptr),
        torch.as_tensor(matrix.indices),
        torch.as_tensor(matrix.data),
    )
    b = torch.linspace(-1, 1, 120, dtype=torch.float64).reshape(2, 60).T  # not contiguous
    x = SparseCholesky(as_torch, torch.as_tensor(coords)).solve(b)
    assert isinstance(x, torch.Tensor) and x.shape == (60, 2)
    expected = SparseCholesky(matrix, coords).solve(b.numpy())
    assert isinstance(expected, np.ndarray)
    assert np.array_equal(x.numpy(), expected)


def test_empty_matrix_and_no_right_hand_sides():
    assert SparseCholesky(sp.csr_matrix((0, 0))).solve(np.zeros(0)).shape == (0,)
    assert SparseCholesky(sp.identity(4, format="csr")).solve(np.zeros((4, 0))).shape == (4, 0)


@pytest.mark.parametrize("block", [1, 3])
@pytest.mark.parametrize("shape", [(2, 1, 1), (6, 5, 4), (16, 14, 12)])
def test_singular_neumann_matrix_is_refused(block, shape):
    pattern, coords = grid_graph(*shape)
    matrix = laplacian(pattern, block=block)
    with pytest.raises(FactorizationError, match=r"positive definite, got pivot .*Dirichlet") as e:
        SparseCholesky(matrix, coords, block=block)
    assert abs(e.value.value) < 1e-9  # rounding of zero, entries are of order one
    assert 0 <= e.value.pivot < matrix.shape[0]


@pytest.mark.parametrize("num_threads", [1, 2])
def test_indefinite_matrix_names_the_pivot_and_leaves_no_factor(num_threads):
    pattern, coords = grid_graph(12, 12, 12)
    matrix = laplacian(pattern, shift=1.0)
    factor = SparseCholesky(matrix, coords, num_threads=num_threads)
    bad = matrix.tolil()
    bad[777, 777] = -5.0
    with pytest.raises(FactorizationError, match="at unknown 777") as e:
        factor.refactor(bad.tocsr())
    assert e.value.pivot == 777
    assert e.value.value <= -5.0  # elimination can only lower it
    with pytest.raises(FactorizationError, match="last refactor failed"):
        factor.solve(np.ones(matrix.shape[0]))
    factor.refactor(matrix)
    assert np.isfinite(factor.solve(np.ones(matrix.shape[0]))).all()


def test_refuses_bad_matrices():
    good = laplacian(grid_graph(3, 3, 3)[0], shift=1.0)
    with pytest.raises(TypeError, match="scipy sparse matrix or a torch sparse CSR"):
        SparseCholesky(good.toarray())
    with pytest.raises(TypeError, match="must be float64, got float32"):
        SparseCholesky(good.astype(np.float32))
    with pytest.raises(ValueError, match=r"must be square, got shape \(26, 27\)"):
        SparseCholesky(good[:26])
    with pytest.raises(ValueError, match="multiple of block = 2 rows, got 27"):
        SparseCholesky(good, block=2)
    with pytest.raises(ValueError, match="block must be an integer from 1 to 6"):
        SparseCholesky(good, block=7)
    with pytest.raises(ValueError, match="did you mean 'float32'"):
        SparseCholesky(good, precision="float23")
    with pytest.raises(ValueError, match=r"must be symmetric, got A\[.*store both triangles"):
        SparseCholesky(sp.tril(good, format="csr"))
    bad = good.copy()
    bad[3, 4] = np.nan
    with pytest.raises(ValueError, match=r"must be finite, got nan at \(3, 4\)"):
        SparseCholesky(bad)
    with pytest.raises(ValueError, match="coords must have shape"):
        SparseCholesky(good, np.zeros((26, 3)))


def test_refuses_another_pattern_and_bad_right_hand_sides():
    pattern, coords = grid_graph(4, 4, 4)
    matrix = laplacian(pattern, shift=1.0)
    factor = SparseCholesky(matrix, coords)
    with pytest.raises(ValueError, match="sparsity pattern it was analyzed with"):
        factor.refactor(sp.identity(64, format="csr"))
    with pytest.raises(ValueError, match=r"shape \(64, 64\), got \(27, 27\)"):
        factor.refactor(laplacian(grid_graph(3, 3, 3)[0], shift=1.0))
    with pytest.raises(ValueError, match="b must have shape"):
        factor.solve(np.ones(63))
    with pytest.raises(ValueError, match="b must have shape"):
        factor.solve(np.ones((64, 3, 1)))
    with pytest.raises(ValueError, match="no gradient"):
        factor.solve(torch.ones(64, dtype=torch.float64, requires_grad=True))


def test_a_solution_without_room_is_refused():
    """1e3 over 1e-308 was inf, without a word."""
    factor = SparseCholesky(sp.identity(3, format="csr") * 1e-308)
    b = torch.tensor([1e-3, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(factor.solve(b), b / 1e-308)
    b[0] = 1e3
    with pytest.raises(FactorizationError, match="beyond what float64 holds"):
        factor.solve(b)
