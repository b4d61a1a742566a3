"""Does the preconditioned solver beat a direct one where the thesis's did not (its Fig. 4-19)?

An armadillo-like creature of 44,000 DoF stands on clamped feet; head and shoulders are turned by
half a turn within one second, 30 frames of one implicit step each, neo-Hookean. The loss is how far
the right hand ends to one side; its gradient to Young's modulus and to the angle of the turn goes
back through all steps. The thesis found no speed-up of the backward pass over a direct solver with
this material. There is no contact: limbs may pass through each other.

Expected: `auto` and `newton_cholesky` end in the same shape and gradient. Measured with --compare
on two busy cores, CPU seconds per step: forward 1.47 against 2.53, backward 0.70 against 0.64. On
this slender creature `auto` factorizes backward, as the direct solve does;
docs/measured/soft.md has a compact beam, where conjugate gradients win. Running time: 3 minutes of
CPU with --compare, seconds with --small.

    python examples/softbody/twisting_armadillo.py --compare --plot runs/armadillo.png
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import math
import time
from pathlib import Path

import torch
from torch import Tensor

from diffsim import mesh, soft

HEIGHT = 0.6  # [m]
FEET, SHOULDERS, REACH = 0.09, 0.74, 0.16  # parts of the height: clamped below, turned above
FRAMES, DT = 30, 1.0 / 30.0  # [-], [s]


def ellipsoid(
    center: tuple[float, float, float], radii: tuple[float, float, float]
) -> mesh.sdf.Sdf:
    """Exact surface, and the right sign away from it [m]."""
    c, r = torch.tensor(center, dtype=torch.float64), torch.tensor(radii, dtype=torch.float64)
    return lambda x: (((x - c) / r).norm(dim=1) - 1.0) * r.min()


def creature() -> mesh.sdf.Sdf:
    """An upright animal with shell, snout, ears, raised arms and a tail; faces -y, 0.6 m tall."""
    parts = [
        ellipsoid((0.0, 0.0, 0.27), (0.105, 0.095, 0.14)),  # belly
        ellipsoid((0.0, 0.035, 0.31), (0.115, 0.09, 0.15)),  # shell
        ellipsoid((0.0, 0.0, 0.405), (0.09, 0.075, 0.07)),  # chest
        mesh.sdf.capsule((0.0, 0.0, 0.42), (0.0, -0.02, 0.5), 0.042),  # neck
        ellipsoid((0.0, -0.03, 0.515), (0.058, 0.065, 0.052)),  # head
        mesh.sdf.capsule((0.0, -0.07, 0.505), (0.0, -0.135, 0.49), 0.026),  # snout
    ]
    for side in (-1.0, 1.0):
        parts += [
            ellipsoid((side * 0.055, 0.0, 0.56), (0.021, 0.02, 0.045)),  # ears
            mesh.sdf.capsule((side * 0.06, 0.0, 0.42), (side * 0.15, -0.01, 0.39), 0.036),
            mesh.sdf.capsule((side * 0.15, -0.01, 0.39), (side * 0.205, -0.06, 0.455), 0.03),
            ellipsoid((side * 0.215, -0.07, 0.475), (0.036, 0.03, 0.04)),  # hands
            mesh.sdf.capsule((side * 0.06, 0.0, 0.2), (side * 0.095, -0.02, 0.12), 0.056),
            mesh.sdf.capsule((side * 0.095, -0.02, 0.12), (side * 0.1, 0.01, 0.045), 0.043),
            ellipsoid((side * 0.105, -0.03, 0.03), (0.045, 0.078, 0.034)),  # feet
        ]
    tail = [(0.0, 0.08, 0.18), (0.0, 0.16, 0.13), (0.0, 0.22, 0.12), (0.0, 0.27, 0.145)]
    for k, radius in enumerate((0.042, 0.031, 0.022)):
        parts.append(mesh.sdf.capsule(tail[k], tail[k + 1], radius))
    return mesh.sdf.union(*parts)


def make_mesh(spacing: float, file: str | None) -> mesh.TetMesh:
    """The creature, or a user's tetrahedra or closed surface, scaled to HEIGHT and put on z = 0."""
    if file is None:
        m = mesh.tet_from_sdf(creature(), [(-0.27, -0.18, -0.01), (0.27, 0.31, 0.62)], spacing)
    elif Path(file).suffix.lower() in (".stl", ".obj", ".ply", ".off"):
        surface = mesh.load_surface(file)
        m = mesh.tetrahedralize(surface, spacing * float(surface.extents[2]) / HEIGHT)
    else:
        loaded = mesh.load(file)
        if not isinstance(loaded, mesh.TetMesh):
            raise SystemExit(f"{file} holds hexahedra; this story needs tetrahedra or a surface")
        m = loaded
    x = m.x_rest - m.x_rest.amin(0)
    x = x * (HEIGHT / x[:, 2].max())
    center = 0.5 * x[:, :2].amax(0)  # of the bounding box
    return mesh.TetMesh(torch.cat([x[:, :2] - center, x[:, 2:]], 1), m.elements)


class Turn:
    """Feet held, head and shoulders turned about their own vertical axis.

    Attributes:
        fixed: Nodes of both, (num_nodes,) bool.
        top: The turned ones, (num_nodes,) bool.
    """

    def __init__(self, x_rest: Tensor):
        height = x_rest[:, 2] / HEIGHT
        above = height > SHOULDERS
        if not bool(above.any()):
            raise SystemExit("no node lies above the shoulders")
        self.axis = x_rest[above, :2].mean(0)
        near = (x_rest[:, :2] - self.axis).norm(dim=1) < REACH * HEIGHT
        self.top = above & near
        self.fixed = self.top | (height < FEET)
        self.x_rest = x_rest

    def target(self, angle: Tensor) -> Tensor:
        """Prescribed positions, (num_nodes, 3) [m]; angle scalar [rad]."""
        x, y = (self.x_rest[:, :2] - self.axis).unbind(1)
        turned = torch.stack(
            [
                self.axis[0] + x * torch.cos(angle) - y * torch.sin(angle),
                self.axis[1] + x * torch.sin(angle) + y * torch.cos(angle),
                self.x_rest[:, 2],
            ],
            1,
        )
        return torch.where(self.top[:, None], turned, self.x_rest)


def simulate(
    body: soft.SoftBody, turn: Turn, degrees: float, frames: int
) -> tuple[list[Tensor], dict[str, float]]:
    """All frames of the turn, and losses, gradients and times of one forward and backward pass."""
    youngs_modulus = torch.tensor(float(body.youngs_modulus), dtype=torch.float64).requires_grad_()
    angle = torch.tensor(math.radians(degrees), dtype=torch.float64).requires_grad_()
    physics = body.physics(youngs_modulus=youngs_modulus)
    state = body.rest_state()
    hand = turn.x_rest[:, 0].argmin()
    shapes, seconds = [state.x], []
    with soft.record_stats() as solves:
        for frame in range(frames):
            start = time.process_time()
            target = turn.target(angle * ((frame + 1) / FRAMES))
            state = body(state, dirichlet_target=target, physics=physics)
            seconds.append(time.process_time() - start)
            shapes.append(state.x.detach())
        start = time.process_time()
        state.x[hand, 0].backward()
        backward = time.process_time() - start
    steps = [s for s in solves if s.kind == "step"]
    adjoints = [s for s in solves if s.kind == "adjoint"]
    assert youngs_modulus.grad is not None and angle.grad is not None
    return shapes, {
        "hand_mm": 1e3 * float(state.x[hand, 0].detach()),
        "hand_per_degree_mm": 1e3 * math.radians(float(angle.grad)),
        "hand_per_modulus_mm": 1e3 * float(youngs_modulus.grad * youngs_modulus.detach()),
        "forward_cpu_s_per_step": sum(seconds) / frames,
        "forward_cpu_s_median": sorted(seconds)[frames // 2],
        "backward_cpu_s_per_step": backward / frames,
        "newton_iterations_per_step": sum(float(s.num_iters) for s in steps) / frames,
        "step_factorizations": sum(float(s.num_factorizations) for s in steps) / frames,
        "adjoint_iterations": sum(float(s.num_iters) for s in adjoints) / frames,
        "adjoint_factorizations": sum(float(s.num_factorizations) for s in adjoints) / frames,
    }


def main(
    spacing: float = 0.01425,
    degrees: float = 180.0,
    frames: int = FRAMES,
    material: str = "neo_hookean",
    poissons_ratio: float = 0.45,
    rtol: float = 1e-4,
    methods: tuple[str, ...] = ("auto",),
    file: str | None = None,
    plot: str | None = None,
) -> dict[str, float]:
    """Turn, with each method in order; returns the numbers that the story ends with.

    Args:
        spacing: Longest edge of a tetrahedron [m]; 0.01425 gives 44,000 DoF.
        degrees: Turn within one second.
        frames: Frames to simulate; FRAMES are one second.
        material: See :mod:`diffsim.soft.materials`.
        poissons_ratio: [-].
        rtol: Of steps and adjoints [-].
        methods: Names of :class:`diffsim.soft.SolverOptions`; the first is drawn.
        file: A user's own tetrahedra or closed surface.
        plot: Where to put the picture.
    """
    m = make_mesh(spacing, file)
    turn = Turn(m.x_rest)
    numbers: dict[str, float] = {"num_dof": 3 * m.num_nodes, "num_elements": m.num_elements}
    first: list[Tensor] | None = None
    for method in methods:
        body = soft.SoftBody(
            m,
            dt=DT,
            element="standard",
            youngs_modulus=2e5,
            poissons_ratio=poissons_ratio,
            material=material,
            fixed=turn.fixed,
            solver=soft.SolverOptions(method=method, rtol=rtol),
        )
        with torch.no_grad():
            body(body.rest_state())  # analysis and factor, once per body: not timed
        shapes, found = simulate(body, turn, degrees, frames)
        numbers |= {f"{method}.{name}": value for name, value in found.items()}
        if first is None:
            first = shapes
        else:
            apart = max(
                float((a - b).norm(dim=1).max()) for a, b in zip(first, shapes, strict=True)
            )
            numbers[f"{method}.largest_difference_mm"] = 1e3 * apart
    if plot and first is not None:
        draw(m, first, turn, Path(plot))
    return numbers


def draw(m: mesh.TetMesh, shapes: list[Tensor], turn: Turn, path: Path) -> None:
    """Four frames, side by side; clamped and turned parts in other colors."""
    import matplotlib.pyplot as plt
    import numpy as np
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    faces = mesh.surface_triangles(m).faces
    fixed = turn.fixed[faces].all(1)
    top = turn.top[faces].all(1)
    base = np.where(top[:, None], [[0.80, 0.45, 0.20]], [[0.33, 0.60, 0.55]])
    base = np.where((fixed & ~top)[:, None], [[0.35, 0.36, 0.40]], base)
    light = np.array([0.35, -0.75, 0.56])
    figure = plt.figure(figsize=(13, 4.6))
    chosen = [round(k * (len(shapes) - 1) / 3) for k in range(4)]
    for k, frame in enumerate(chosen):
        axes = figure.add_axes((0.245 * k - 0.06, -0.12, 0.385, 1.24), projection="3d")
        axes.patch.set_alpha(0.0)  # neighbors overlap
        axes.set_clip_on(False)
        corner = shapes[frame][faces].numpy()
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        shade = 0.42 + 0.58 * np.clip(normal @ light, 0.0, 1.0)
        colors = np.clip(base * shade[:, None], 0.0, 1.0)
        axes.add_collection3d(
            Poly3DCollection(
                corner, facecolors=colors, edgecolors=colors, linewidths=0.15, clip_on=False
            )
        )
        axes.set(xlim=(-0.26, 0.26), ylim=(-0.26, 0.26), zlim=(0.02, HEIGHT - 0.02))
        axes.set_box_aspect((0.52, 0.52, HEIGHT - 0.04), zoom=1.1)
        axes.view_init(8, -62)
        axes.set_axis_off()
        figure.text(0.245 * k + 0.1325, 0.03, f"{frame * DT:.2f} s", ha="center", fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


SMALL = {"spacing": 0.045, "frames": 6, "degrees": 90.0}

if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--small", action="store_true", help="a coarse creature, a few frames")
        parser.add_argument("--compare", action="store_true", help="also by a direct solver")
        parser.add_argument(
            "--mesh", metavar="FILE", help="tetrahedra or a closed surface of your own"
        )
        parser.add_argument("--spacing", type=float, help="longest edge of a tetrahedron [m]")
        parser.add_argument("--frames", type=int, help="frames to simulate, 30 are one second")
        parser.add_argument("--material", default="neo_hookean", choices=soft.MATERIALS)
        parser.add_argument("--poissons-ratio", type=float, default=0.45)
        parser.add_argument("--rtol", type=float, default=1e-4)
        parser.add_argument("--plot", metavar="PNG", help="write the picture here")
        args = parser.parse_args()
        torch.set_num_threads(1)  # process time counts those that only wait
        options = dict(SMALL) if args.small else {}
        options |= {k: v for k in ("spacing", "frames") if (v := getattr(args, k)) is not None}
        result = main(
            **options,
            material=args.material,
            poissons_ratio=args.poissons_ratio,
            rtol=args.rtol,
            methods=("auto", "newton_cholesky") if args.compare else ("auto",),
            file=args.mesh,
            plot=args.plot,
        )
        for name, value in result.items():
            print(f"{name:44s} {value:.4g}")
