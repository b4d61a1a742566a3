"""Which element, how many cells: error and CPU seconds against closed forms, by element, nu, cells.

``python -m benchmarks.elements`` prints the tables of docs/soft.md; ``--case beam`` one of them.

* beam: 1 x 0.1 x 0.1 m under a tip load, its end held as beam theory has it; Timoshenko's
  deflection. ``clamped``: the same with all of the end held, which stiffens it by 2.0 % at nu 0.49.
* cook: Cook's membrane in plane stress, nu 1/3: 23.96 F/E at the middle of its end (Cook 1974).
* ring: a quarter of a long ring, radii 1 and 2, under pressure inside; Lame's displacement.
* twist: a bar 3 x 1 x 1 turned by 180 degrees, neo-Hookean; its energy, against 36 x 12 x 12 cells.
* cost: CPU milliseconds of a step and of its adjoint of a bar that falls, solver ``auto``.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from diffsim import mesh, soft

STILL = (0.0, 0.0, 0.0)


def elements_of(cells: tuple[int, int, int]) -> Iterator[tuple[str, str]]:
    """Kinds of mesh and elements that have the nodes of these cells."""
    yield "hex", "standard"
    yield "hex", "assumed_strain"
    yield "tet", "standard"
    if not any(n % 2 for n in cells):
        yield "tet", "quadratic"


def box(
    kind: str, element: str, cells: tuple[int, int, int], size, origin=(0.0, 0.0, 0.0)
) -> mesh.HexMesh | mesh.TetMesh:
    """A box with the nodes of ``cells``, whatever its elements; tetrahedra are symmetric."""
    if kind == "hex":
        return mesh.hex_box(cells, size, origin)
    if element == "standard":
        return mesh.tet_box(cells, size, origin, symmetric=True)
    half = tuple(n // 2 for n in cells)
    return mesh.split_tets(mesh.tet_box(half, size, origin, symmetric=True))


def body_of(m, element: str, nu: float, modulus: float, fixed: Tensor, **changes) -> soft.SoftBody:
    """A body without weight."""
    return soft.SoftBody(
        m, dt=0.01, youngs_modulus=modulus, poissons_ratio=nu, gravity=STILL, fixed=fixed,
        element=element, **changes,
    )  # fmt: skip


def end_shares(m, tip: Tensor, spans) -> Tensor:
    """Shares of a load spread evenly over a rectangular end, by nodes; sums to one."""
    share = torch.ones(len(tip), dtype=torch.float64)
    for axis, half in spans:
        share[(m.x_rest[tip, axis].abs() - half).abs() < 1e-9] *= 0.5
    return share / share.sum()


def beam(
    kind: str, element: str, nu: float, cells: tuple[int, int, int], clamped: bool = False
) -> tuple[float, float, float]:
    """Deflection by theory [-], sideways by deflection [-], CPU [s]."""
    modulus, deflection, length, side = 21e9, 1e-3, 1.0, 0.1
    m = box(kind, element, cells, (length, side, side), (0.0, -side / 2, -side / 2))
    bending = length**3 / (3.0 * modulus * side**4 / 12.0)
    shear = length / (5.0 / 6.0 * modulus / (2.0 * (1.0 + nu)) * side**2)
    end, tip = m.nodes_near_plane("x", 0.0), m.nodes_near_plane("x", length)
    fixed = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    fixed[end, 0] = True
    middle = m.x_rest[end].abs() < 1e-9
    fixed[end[middle[:, 1]], 1] = True
    fixed[end[middle[:, 2]], 2] = True
    if clamped:
        fixed[end] = True
    force = torch.zeros_like(m.x_rest)
    shares = end_shares(m, tip, ((1, side / 2), (2, side / 2)))
    force[tip, 2] = deflection / (bending + shear) * shares
    body = body_of(m, element, nu, modulus, fixed)
    start = time.process_time()
    x = body.static_equilibrium(external_force=force).x
    spent = time.process_time() - start
    moved = (shares[:, None] * (x - m.x_rest)[tip]).sum(0)
    return float(moved[2]) / deflection, float((moved[1] / moved[2]).abs()), spent


def cook(element: str, n: int) -> float:
    """Displacement of the end's middle by Cook's [-]; n is even."""
    square = mesh.hex_box((n, n, 1))
    s, t, z = square.x_rest.T
    y = t * (44.0 - 28.0 * s) + 44.0 * s
    scale, modulus = 1e-2, 1e6  # [m], [Pa]
    m = mesh.HexMesh(scale * torch.stack([48.0 * s, y, z], 1), square.hexes)
    end = m.nodes_near_plane("x", 48.0 * scale)
    fixed = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    fixed[m.nodes_near_plane("x", 0.0), :2] = True
    fixed[m.nodes_near_plane("z", 0.0), 2] = True
    load = 1e-6 * modulus * scale**2  # small strains
    force = torch.zeros_like(m.x_rest)
    share = torch.ones(len(end), dtype=torch.float64)
    share[(t[end] < 1e-9) | (t[end] > 1.0 - 1e-9)] *= 0.5
    force[end, 1] = load * share / share.sum()
    body = body_of(m, element, 1.0 / 3.0, modulus, fixed, solver=soft.SolverOptions(rtol=1e-5))
    moved = body.static_equilibrium(external_force=force).x - m.x_rest
    middle = end[(t[end] - 0.5).abs() < 1e-9]
    return float(moved[middle, 1].mean()) / (23.96 * load / (modulus * scale))


def ring(element: str, nu: float, n: int) -> float:
    """Displacement of the outer radius by Lame's [-]; 2 n cells along the quarter, n across."""
    inner, outer, modulus, pressure = 1.0, 2.0, 1e6, 1.0
    square = mesh.hex_box((n, 2 * n, 1), (1.0, 1.0, 0.2))
    r, angle = inner + square.x_rest[:, 0], square.x_rest[:, 1] * math.pi / 2
    m = mesh.HexMesh(
        torch.stack([r * torch.cos(angle), r * torch.sin(angle), square.x_rest[:, 2]], 1),
        square.hexes,
    )
    fixed = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    fixed[:, 2] = True  # plane strain
    fixed[m.nodes_near_plane("x", 0.0), 0] = True
    fixed[m.nodes_near_plane("y", 0.0), 1] = True
    inside = (r - inner).abs() < 1e-9
    width = 0.1 * inner * math.sin(math.pi / 4 / n)  # projected area of a node's faces
    share = torch.where((angle < 1e-9) | (angle > math.pi / 2 - 1e-9), 0.5, 1.0).double()
    force = torch.zeros_like(m.x_rest)
    outwards = torch.stack([torch.cos(angle), torch.sin(angle), 0 * angle], 1)
    force[inside] = (pressure * width * share[:, None] * outwards)[inside]
    body = body_of(m, element, nu, modulus, fixed, solver=soft.SolverOptions(rtol=1e-5))
    x = body.static_equilibrium(external_force=force).x
    rim = (r - outer).abs() < 1e-9
    found = float(((x - m.x_rest) * outwards)[rim].sum(1).mean())
    factor = (1.0 + nu) / modulus * pressure * inner**2 / (outer**2 - inner**2)
    return found / (factor * ((1.0 - 2.0 * nu) * outer + outer**2 / outer))


def twist(kind: str, element: str, nu: float, n: int) -> float:
    """Energy of a bar of 3 n x n x n cells turned by 180 degrees, by E V [-]."""
    m = box(kind, element, (3 * n, n, n), (3.0, 1.0, 1.0), (0.0, -0.5, -0.5))
    ends = torch.cat([m.nodes_near_plane("x", 0.0), m.nodes_near_plane("x", 3.0)])
    solver = soft.SolverOptions(method="newton_cholesky", rtol=1e-6)
    body = body_of(m, element, nu, 1e6, ends, material="neo_hookean", solver=solver)
    turn, x = math.pi / 12 * m.x_rest[:, 0] / 3.0, m.x_rest
    for _ in range(12):
        y, z = x[:, 1], x[:, 2]
        guess = torch.stack(
            [x[:, 0], y * turn.cos() - z * turn.sin(), y * turn.sin() + z * turn.cos()], 1
        )
        x = body.static_equilibrium(guess=guess, dirichlet_target=guess).x
    return float(body.elastic_energy(x)) / 3e6


def cost(kind: str, element: str, cells: tuple[int, int, int], steps: int = 8) -> tuple[float, ...]:
    """CPU of a step and of its adjoint, the least of three runs [ms]."""
    m = box(kind, element, cells, (1.0, 0.25, 0.25))
    body = soft.SoftBody(
        m, dt=0.01, youngs_modulus=1e6, poissons_ratio=0.45, element=element,
        fixed=m.nodes_near_plane("x", 0.0), solver=soft.SolverOptions(rtol=1e-4),
    )  # fmt: skip
    body(body.rest_state())  # the constant factor
    least = [math.inf, math.inf]
    for _ in range(3):
        v = torch.zeros_like(m.x_rest).requires_grad_()
        start = time.process_time()
        end = soft.rollout(body, soft.State(m.x_rest, v), steps).x[-1]
        middle = time.process_time()
        end.sum().backward()
        spent = middle - start, time.process_time() - middle
        least = [min(old, 1e3 * new / steps) for old, new in zip(least, spent, strict=True)]
    return tuple(least)


def _beams(clamped: bool) -> None:
    print("| nu | cells | mesh | element | deflection by theory | sideways | CPU ms |")
    print("| ---: | --- | --- | --- | ---: | ---: | ---: |")
    for nu in (0.3, 0.49):
        for cells in ((10, 2, 2), (20, 4, 4), (40, 4, 4)):
            for kind, element in elements_of(cells):
                share, sideways, spent = beam(kind, element, nu, cells, clamped)
                size = " x ".join(map(str, cells))
                print(
                    f"| {nu} | {size} | {kind} | {element} | {100 * share:.1f} % "
                    f"| {sideways:.0e} | {1e3 * spent:.0f} |",
                    flush=True,
                )


def _pairs(name: str, sizes: tuple[int, ...], case: Callable[[str, int], float]) -> None:
    print("| case | element | " + " | ".join(f"n = {n}" for n in sizes) + " |")
    print("| --- | --- |" + " ---: |" * len(sizes))
    for element in ("standard", "assumed_strain"):
        row = " | ".join(f"{100 * case(element, n):.1f} %" for n in sizes)
        print(f"| {name} | {element} | {row} |", flush=True)


def _twists() -> None:
    for nu in (0.3, 0.49):
        fine = twist("hex", "assumed_strain", nu, 12)
        for kind, element, sizes in (
            ("hex", "standard", (2, 4, 6)),
            ("hex", "assumed_strain", (2, 4, 6)),
            ("tet", "standard", (2, 4, 6)),
            ("tet", "quadratic", (2, 4, 6)),
        ):
            row = " | ".join(f"{100 * twist(kind, element, nu, n) / fine:.1f} %" for n in sizes)
            print(f"| {nu} | {kind} | {element} | {row} |", flush=True)


def _costs() -> None:
    print(
        "| cells | mesh | element | step [ms] | adjoint [ms] |\n| --- | --- | --- | ---: | ---: |"
    )
    for cells in ((8, 2, 2), (32, 8, 8)):
        for kind, element in elements_of(cells):
            forward, backward = cost(kind, element, cells)
            size = " x ".join(map(str, cells))
            print(f"| {size} | {kind} | {element} | {forward:.2f} | {backward:.2f} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    cases = {
        "beam": lambda: _beams(False),
        "clamped": lambda: _beams(True),
        "cook": lambda: _pairs("Cook", (2, 4, 8, 16), cook),
        "ring": lambda: [
            _pairs(f"ring, nu {nu}", (2, 4, 8), lambda e, n, nu=nu: ring(e, nu, n))
            for nu in (0.3, 0.49)
        ],
        "twist": _twists,
        "cost": _costs,
    }
    parser.add_argument("--case", choices=tuple(cases), help="one of them alone")
    chosen = parser.parse_args().case
    for name in cases if chosen is None else [chosen]:
        print(f"\n{name}\n")
        cases[name]()


if __name__ == "__main__":
    main()
