"""What single operations cost at one mesh size: the parts that a step is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse
import torch

from benchmarks.harness import cores, repeat_for, spread, timed
from benchmarks.soft_scenes import cantilever, loss_weights, twisted
from diffsim import mesh
from diffsim.core.compiled import core

# Larger factorizations of the 3x3-block tangent are not tried: about ten seconds on one core.
MAX_BLOCK_FLOPS = 4e11


def operations(settings: dict[str, Any]) -> dict[str, Any]:
    """Median times [s] of the operations of a step on one mesh.

    ``gradient``: elastic force of all elements. ``hessian_product``: assembly of the tangent, one
    product with it and the parameters' gradients (one call of the force's adjoint). ``scalar_*``:
    the constant matrix, one unknown per node; ``block_*``: the tangent, three per node; each:
    analysis, factorization, one solve of three or one right-hand sides. The factors belong to a
    matrix of the same pattern with other numbers, which cost the same.
    """
    torch.set_num_threads(1)
    with cores(settings["threads"]):
        return _operations(settings)


def _operations(settings: dict[str, Any]) -> dict[str, Any]:
    threads, seconds = settings["threads"], settings["seconds"] / 4
    body = cantilever(settings["kind"], settings["cells"])
    body.solver = type(body.solver)(num_threads=threads)
    x = twisted(body)
    weight, _ = loss_weights(body.mesh.num_nodes)

    def median(call: Callable[[], object]) -> float:
        return spread([t.cpu for t in repeat_for(call, seconds=seconds)])["median"]

    with torch.no_grad():
        found = {"gradient_s": median(lambda: body.elastic_force(x))}
    leaf = x.clone().requires_grad_()
    force = body.elastic_force(leaf)
    found["hessian_product_s"] = median(
        lambda: torch.autograd.grad(force, leaf, weight, retain_graph=True)
    )
    graph = node_graph(body.mesh)
    coords = body.mesh.x_rest
    for name, block, single in (
        ("scalar", 1, False),
        ("scalar_float32", 1, True),
        ("block", 3, False),
    ):
        found |= factor_times(name, graph, coords, block, single, threads, median)
    return {
        "task": "operations",
        "kind": settings["kind"],
        "num_dof": 3 * body.mesh.num_nodes,
        "tangent_B": 9 * 8 * int(graph.nnz),
        **found,
    }


def factor_times(
    name: str,
    graph: scipy.sparse.csr_array,
    coords: torch.Tensor,
    block: int,
    single: bool,
    threads: int,
    median: Callable[[Callable[[], object]], float],
) -> dict[str, float]:
    """Analysis, factorization and solve of a matrix with ``block`` unknowns per node."""
    indptr, indices = (part.astype(np.int64) for part in (graph.indptr, graph.indices))
    factor, analysis = timed(
        lambda: core.SparseFactor(
            graph.shape[0],
            indptr.ctypes.data,
            indices.ctypes.data,
            coords.data_ptr(),
            block,
            single,
        )
    )
    found = {
        f"{name}_analysis_s": analysis.cpu,
        f"{name}_flops": factor.flops,
        f"{name}_factor_B": factor.bytes,
    }
    if factor.flops > MAX_BLOCK_FLOPS:
        return found
    values = np.ascontiguousarray(graph.data[:, None, None] * np.eye(block))
    found[f"{name}_factor_s"] = median(lambda: factor.refactor(values.ctypes.data, threads))
    num_rhs = 3 // block
    b = np.random.default_rng(0).standard_normal((graph.shape[0] * block, num_rhs))
    z = np.empty_like(b)
    found[f"{name}_solve_s"] = median(
        lambda: factor.solve(b.ctypes.data, z.ctypes.data, num_rhs, threads)
    )
    return found


def node_graph(shape: mesh.Mesh) -> scipy.sparse.csr_array:
    """Laplacian plus identity of the graph of nodes that share an element, CSR."""
    elements = shape.elements.numpy()
    count, corners = elements.shape
    ones = np.ones(elements.size)
    rows = np.repeat(np.arange(count), corners)
    incidence = scipy.sparse.csr_array((ones, (rows, elements.ravel())), (count, shape.num_nodes))
    graph = scipy.sparse.csr_array(incidence.T @ incidence)
    graph.data[:] = -1.0
    diagonal = np.diff(graph.indptr).astype(float)
    graph = graph + scipy.sparse.diags_array(diagonal + 1.0)
    graph.sort_indices()
    return scipy.sparse.csr_array(graph)
