"""The Mosaic entry against an assembly of its own, values that Mosaic keeps, and differences."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from benchmarks.mosaic import soft_dynamics, stokes_shape
from benchmarks.mosaic.structural_mesh import cantilever
from benchmarks.mosaic.structural_mesh.compliance import (
    Groups,
    cached,
    compliance,
    compliance_gradient,
    prepare,
    problem_of,
)

CORNERS = np.array(  # Abaqus's and VTK's order
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)


def assembled(problem, rho):
    """K of trilinear hexahedra: B' C B in Voigt's notation at 2 x 2 x 2 Gauss points."""
    lam = problem.nu / ((1 + problem.nu) * (1 - 2 * problem.nu))
    mu = 0.5 / (1 + problem.nu)
    law = np.diag([2 * mu] * 3 + [mu] * 3)
    law[:3, :3] += lam
    rows, cols, values = [], [], []
    for cell, density in zip(problem.cells, rho, strict=True):
        corners = problem.points[cell].astype(float)
        stiffness = np.zeros((24, 24))
        for s in itertools.product((0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5), repeat=3):
            factors = np.where(CORNERS == 1, s, 1 - np.array(s))
            slopes = np.where(CORNERS == 1, 1.0, -1.0)
            local = np.stack(
                [slopes[:, a] * np.delete(factors, a, axis=1).prod(1) for a in range(3)]
            )
            jacobian = local @ corners
            d = np.linalg.solve(jacobian, local)
            b = np.zeros((6, 24))
            for a in range(3):
                b[a, a::3] = d[a]
            for row, (p, q) in enumerate(((0, 1), (1, 2), (0, 2)), start=3):
                b[row, p::3], b[row, q::3] = d[q], d[p]
            stiffness += b.T @ law @ b * np.linalg.det(jacobian) / 8
        young = problem.e_max * (problem.xmin + (1 - problem.xmin) * density**3)
        dofs = (3 * cell[:, None] + np.arange(3)).ravel()
        rows.append(np.repeat(dofs, 24))
        cols.append(np.tile(dofs, 24))
        values.append(young * stiffness.ravel())
    size = 3 * len(problem.points)
    data, i, j = (np.concatenate(a) for a in (values, rows, cols))
    return sp.csc_matrix((data, (i, j)), shape=(size, size))


def solved(problem, rho, force, shift):
    stiffness = assembled(problem, rho)
    free = ~np.repeat(problem.held.nodes(len(problem.points)), 3)
    u = shift.ravel().copy()
    right = force.ravel() - stiffness @ u
    u[free] = spla.spsolve(stiffness[free][:, free], right[free])
    return u


def crooked(kind="force"):
    """Moved nodes, mixed densities, two groups of loads, cells and nodes that are not in use."""
    rng = np.random.default_rng(3)
    given = cantilever.inputs((4, 2, 3), kind=kind)
    given["rho"] = rng.uniform(0.05, 1.0, 30).astype(np.float32)  # six too many
    points = given["hex_mesh"]["points"]
    inner = (points[:, 0] > 0) & (points[:, 0] < 2)
    points[inner] += 0.05 * rng.standard_normal((inner.sum(), 3)).astype(np.float32)
    given["hex_mesh"]["points"] = np.vstack([points, np.full((5, 3), 9.0, np.float32)])
    cells = given["hex_mesh"]["faces"]
    given["hex_mesh"]["faces"] = np.vstack([cells, np.zeros((6, 8), np.int32)])
    neumann = given["boundary_conditions"]["neumann"]
    if kind == "force":
        neumann["mask"][np.flatnonzero(neumann["mask"])[:3]] = 2
        neumann["values"] = np.array([[0, 0.1, -0.2], [0.3, 0, 0]], np.float32)
    return given


@pytest.mark.parametrize("moved", [False, True])
def test_compliance_and_gradient(moved):
    problem, rho = problem_of(crooked())
    if moved:
        values = np.array([[1e-6, -2e-6, 3e-6]])
        problem = type(problem)(**{**vars(problem), "held": Groups(problem.held.mask, values)})
    prepared = prepare(problem)
    force, shift = prepared.force.numpy(), prepared.shift.numpy()
    expected = force.ravel() @ solved(problem, rho, force, shift)
    assert compliance(prepared, rho) == pytest.approx(expected, rel=1e-9)
    value, slope = compliance_gradient(prepared, rho)
    assert value == pytest.approx(expected, rel=1e-9)
    for cell in (0, 7, 23):
        step = np.zeros_like(rho)
        step[cell] = 1e-4
        ends = [force.ravel() @ solved(problem, rho + s * step, force, shift) for s in (1, -1)]
        assert slope[cell] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-6, abs=1e-12)


def test_tractions_add_up_and_follow_the_area():
    prepared = prepare(problem_of(crooked("traction"))[0])
    np.testing.assert_allclose(prepared.force.sum(0).numpy(), [0, 0, -1], atol=1e-7)
    loaded = prepared.force[:, 2].numpy().reshape(5, 3, 4)[-1]
    weight = np.outer([0.25, 0.5, 0.25], np.array([1, 2, 2, 1]) / 6)
    np.testing.assert_allclose(loaded, -weight, rtol=1e-6)


@pytest.mark.parametrize("cells", [4, 8])
def test_the_values_that_mosaic_keeps(cells):
    problem, rho = problem_of(cantilever.inputs((cells, 2, 4), kind="traction"))
    kept = cantilever.KEPT_BY_SIZE[cells]
    assert compliance(prepare(problem), rho) == pytest.approx(kept, rel=1e-5)


def test_a_solid_is_prepared_once_and_never_taken_for_another():
    calls = []

    def counted(problem):
        calls.append(problem)
        return prepare(problem)

    get = cached(counted)
    first, rho = problem_of(cantilever.inputs((2, 1, 1)))
    again, _ = problem_of(cantilever.inputs((2, 1, 1), 0.9))
    other, _ = problem_of({**cantilever.inputs((2, 1, 1)), "nu": 0.2})
    assert get(first) is get(again) and len(calls) == 1
    assert compliance(get(other), rho) != compliance(get(first), rho) and len(calls) == 2
    with pytest.raises(ValueError, match=r"rho must be \(2,\) finite numbers, got \(3,\)"):
        compliance(get(first), np.ones(3))


@pytest.mark.parametrize(
    ("module", "wrt", "of", "scale"),
    [
        (soft_dynamics, "youngs_modulus", "tip_path", 2e5),
        (soft_dynamics, "velocity", "tip_path", 1.0),
        (stokes_shape, "level_set", "outflow", 1.0),
    ],
)
def test_proposed_domains_have_the_gradient_of_what_they_return(module, wrt, of, scale):
    given = module.inputs(4, 8) if module is soft_dynamics else module.inputs()
    rng = np.random.default_rng(0)
    cotangent = rng.standard_normal(module.apply(given)[of].shape).astype(np.float32)
    slope = module.vector_jacobian_product(given, {wrt}, {of}, {of: cotangent})[wrt]
    along = rng.standard_normal(given[wrt].shape) * scale
    # Outputs are float32. Along noise the places where a wall crosses lines of the grid bend: at
    # 3e-4 central differences are 5 % off, at 3e-5 0.1 %.
    step = 1e-2 if module is soft_dynamics else 3e-5
    ends = [
        (module.apply({**given, wrt: given[wrt].astype(float) + s * step * along})[of] * cotangent)
        .astype(float)
        .sum()
        for s in (1, -1)
    ]
    assert (slope * along).sum() == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=5e-3)
    with pytest.raises(ValueError, match="differentiable are"):
        module.vector_jacobian_product(given, {"mass"}, {of}, {of: cotangent})


def test_templates_name_what_the_domains_have():
    import yaml

    folder = Path(soft_dynamics.__file__).parent / "proposals"
    for module, name in ((soft_dynamics, "soft-dynamics"), (stokes_shape, "stokes-shape")):
        template = yaml.safe_load((folder / f"{name}.yaml").read_text())
        assert template["name"] == name and template["output_key"] in module.apply(module.inputs())
        assert template["ic_key"] in module.DIFFERENTIABLE[0] & module.inputs().keys()


def test_the_entry_as_a_tesseract():
    pytest.importorskip("mosaic_shared", reason="Mosaic's schemas")
    core = pytest.importorskip("tesseract_core", reason="pip install tesseract-core[runtime]")
    folder = Path(soft_dynamics.__file__).parent / "structural_mesh"
    entry = core.Tesseract.from_tesseract_api(str(folder / "tesseract_api.py"))
    given = cantilever.inputs((8, 2, 4), kind="traction")
    assert float(entry.apply(given)["compliance"]) == pytest.approx(0.00397532, rel=1e-5)
    pulled = entry.vector_jacobian_product(
        given, ["rho"], ["compliance"], {"compliance": np.float32(2.0)}
    )
    problem, rho = problem_of(given)
    expected = 2.0 * compliance_gradient(prepare(problem), rho)[1]
    np.testing.assert_allclose(pulled["rho"], expected, rtol=1e-5)
