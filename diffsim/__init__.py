"""diffsim: design robots through differentiable simulation.

``import diffsim`` is light: a room is imported when it is first asked for.

    >>> import diffsim
    >>> bar = diffsim.mesh.hex_box((8, 2, 2), (0.1, 0.03, 0.03))
    >>> body = diffsim.soft.SoftBody(bar, dt=0.01, youngs_modulus=1e6, poissons_ratio=0.4)

What a room offers stands in its ``__all__``, and in docs/api.md; the order in which to read the
rooms stands in docs/architecture.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffsim.core.errors import (
    ContactWarning,
    ConvergenceError,
    ConvergenceWarning,
    DiffsimError,
    FactorizationError,
    IntegrationError,
    InvertedElementError,
    MeshError,
)
from diffsim.core.lazy import offered
from diffsim.core.record import Record, Solve, record
from diffsim.core.version import __version__

if TYPE_CHECKING:
    from diffsim import (
        contact,
        control,
        copter,
        core,
        data,
        diagnose,
        envs,
        identify,
        learn,
        linalg,
        mesh,
        ode,
        optim,
        sim_to_real,
        soft,
        stokes,
        systems,
        viz,
    )
    from diffsim.core.precision import in_float64

ROOMS = (
    "contact",
    "control",
    "copter",
    "core",
    "data",
    "diagnose",
    "envs",
    "identify",
    "learn",
    "linalg",
    "mesh",
    "ode",
    "optim",
    "sim_to_real",
    "soft",
    "stokes",
    "systems",
    "viz",
)
if not TYPE_CHECKING:  # to a type checker, any name would be one
    __getattr__, _ = offered(
        __name__,
        {"in_float64": f"{__name__}.core.precision"} | {r: f"{__name__}.{r}" for r in ROOMS},
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *ROOMS, "in_float64"})


__all__ = [
    "ContactWarning",
    "ConvergenceError",
    "ConvergenceWarning",
    "DiffsimError",
    "FactorizationError",
    "IntegrationError",
    "InvertedElementError",
    "MeshError",
    "Record",
    "Solve",
    "__version__",
    "contact",
    "control",
    "copter",
    "core",
    "data",
    "diagnose",
    "envs",
    "identify",
    "in_float64",
    "learn",
    "linalg",
    "mesh",
    "ode",
    "optim",
    "record",
    "sim_to_real",
    "soft",
    "stokes",
    "systems",
    "viz",
]
