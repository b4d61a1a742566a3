"""How stiff the mesh itself is: static sag against mesh and Poisson ratio, and beam theory."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from examples.data.beam import BeamGeometry
from examples.demo.beam import Beam, Setup, timoshenko_sag
from examples.demo.plan import Plan
from examples.demo.workers import Workers


def describe(bar: BeamGeometry, plan: Plan, workers: Workers) -> dict[str, Any]:
    """Sag under own weight at the published Young's modulus, for every mesh.

    Returns:
        ``rows``; and for the demo's own mesh and Poisson ratio: ``factor_finest`` and
        ``factor_beam_theory``, by which an identified modulus is multiplied to get what the
        finest mesh, or Timoshenko's beam, would need for the same stiffness.
    """
    youngs_modulus = bar.youngs_modulus_published_Pa
    cases = [
        (nu, cells)
        for nu in plan.mesh_poissons_ratios
        for cells in plan.mesh_cells
        # the largest system with nearly incompressible elements alone takes as long as the rest
        if not (nu > 0.495 and cells == plan.mesh_cells[-1] and math.prod(cells) > 10000)
    ]

    def job(nu: float, cells: tuple[int, int, int]) -> Callable[[], dict[str, Any]]:
        def compute() -> dict[str, Any]:
            beam = Beam(bar, Setup(cells=cells, poissons_ratio=nu))
            sag = float(beam.sag({"youngs_modulus": youngs_modulus}))
            workers.tick()
            return {
                "cells": list(cells),
                "num_dofs": beam.mesh.num_dofs,
                "poissons_ratio": nu,
                "sag_m": sag,
            }

        return compute

    rows = workers.run([job(nu, cells) for nu, cells in cases])
    mine = {
        tuple(r["cells"]): r["sag_m"] for r in rows if r["poissons_ratio"] == plan.poissons_ratio
    }
    own, finest = mine[plan.cells], mine[plan.mesh_cells[-1]]
    theory = timoshenko_sag(bar, youngs_modulus, plan.poissons_ratio)
    return {
        "youngs_modulus_Pa": youngs_modulus,
        "rows": rows,
        "cells": list(plan.cells),
        "poissons_ratio": plan.poissons_ratio,
        "finest_cells": list(plan.mesh_cells[-1]),
        "timoshenko_sag_m": theory,
        "timoshenko_sag_published_nu_m": timoshenko_sag(bar, youngs_modulus, bar.poissons_ratio),
        "factor_finest": finest / own,
        "factor_beam_theory": theory / own,
    }
