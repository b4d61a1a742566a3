"""What the demo computes, in full and in quick mode."""

from __future__ import annotations

from dataclasses import dataclass

from examples.demo.beam import Setup

Cells = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Sizes of everything.

    Attributes:
        cells: Mesh of all simulations. 20 x 4 x 4 takes about 3 ms a step; how stiff locking makes
            it is measured against the finest mesh below.
        poissons_ratio: Of all simulations but the published number. Trilinear elements lock as it
            nears 0.5, while bending hardly depends on it (Timoshenko: 0.3 % from 0.45 to 0.499).
        published_dt_s: Step of the published practice.
        dt_s: Step of the better simulation (implicit midpoint: no numerical damping, frequency
            off by (w h)^2 / 12 = 0.1 %).
        fit_s: Window of the fit after release; compared are 2 s.
        max_evaluations: Simulations with gradient, at most, per fit.
        mesh_cells: Meshes of the sag study, coarse to fine.
        mesh_poissons_ratios: Poisson ratios of the sag study; the largest leaves out the finest.
        damping_dt_s: Steps of the study of numerical damping.
        diagnosis_effects: Candidate causes of the diagnosis at the end; none: no diagnosis.
    """

    cells: Cells = (20, 4, 4)
    poissons_ratio: float = 0.45
    published_dt_s: float = 1e-2
    dt_s: float = 2.5e-3
    fit_s: float = 1.0
    max_evaluations: int = 12
    mesh_cells: tuple[Cells, ...] = (
        (8, 2, 2),
        (12, 4, 4),
        (20, 4, 4),
        (20, 6, 6),
        (32, 10, 10),
        (48, 16, 16),
    )
    mesh_poissons_ratios: tuple[float, ...] = (0.499, 0.49, 0.45)
    damping_dt_s: tuple[float, ...] = (1e-2, 5e-3, 2.5e-3)
    diagnosis_effects: tuple[str, ...] = ("load_inertia", "loss_factor", "creep", "support_motion")

    def published(self) -> Setup:
        """Implicit Euler, 10 ms, the weight a constant force."""
        return Setup(cells=self.cells, poissons_ratio=self.poissons_ratio, dt_s=self.published_dt_s)

    def better(self) -> Setup:
        """Implicit midpoint with small steps."""
        return self.published().changed(integrator="implicit_midpoint", dt_s=self.dt_s)


FULL = Plan()
QUICK = Plan(
    cells=(8, 2, 2),
    dt_s=5e-3,
    fit_s=0.8,
    max_evaluations=9,
    mesh_cells=((8, 2, 2), (12, 4, 4), (20, 6, 6)),
    damping_dt_s=(1e-2, 5e-3),
)
