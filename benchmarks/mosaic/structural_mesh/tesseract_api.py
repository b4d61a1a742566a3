"""Mosaic's structural-mesh by diffsim: the endpoints of a Tesseract.

Needs ``tesseract_core`` and Mosaic's ``mosaic_shared``, which hold schemas and types alone. Without
them: ``python -m benchmarks.mosaic``, which calls the same functions.
"""

import sys
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mosaic_shared.problems.structural_mesh import InputSchema as CanonicalInput
from mosaic_shared.problems.structural_mesh import OutputSchema as CanonicalOutput
from mosaic_shared.schema_types import make_differentiable
from pydantic import Field
from tesseract_core.runtime import ShapeDType

sys.path.insert(0, str(Path(__file__).parent))
from compliance import cached, compliance, compliance_gradient, problem_of

_prepared = cached()


class InputSchema(make_differentiable(CanonicalInput, ["rho"])):
    """The domain's inputs, with the material and what the values of the loaded group are."""

    E_max: float = Field(default=70_000.0, description="Young's modulus at density 1.")
    nu: float = Field(default=0.3, description="Poisson's ratio.")
    xmin: float = Field(default=1e-3, description="Young's modulus at density 0 over E_max.")
    neumann_kind: Literal["force", "traction"] = Field(
        default="force", description="Values of the loaded group: force per node, or per area."
    )


class OutputSchema(make_differentiable(CanonicalOutput, ["compliance"])):
    """The domain's outputs."""


def apply(inputs: InputSchema) -> OutputSchema:
    """Compliance."""
    problem, rho = problem_of(inputs.model_dump())
    return OutputSchema(compliance=np.float32(compliance(_prepared(problem), rho)))


def vector_jacobian_product(
    inputs: InputSchema,
    vjp_inputs: set[str],
    vjp_outputs: set[str],
    cotangent_vector: dict[str, Any],
) -> dict[str, Any]:
    """Gradient of the compliance in the densities, times its cotangent; unused entries are 0."""
    unknown = (vjp_inputs - {"rho"}) | (vjp_outputs - {"compliance"})
    if unknown:
        raise ValueError(f"differentiable are rho and compliance, got {sorted(unknown)}")
    if "rho" not in vjp_inputs:
        return {}
    problem, rho = problem_of(inputs.model_dump())
    slope = np.zeros(len(np.asarray(inputs.rho)), np.float32)
    if "compliance" in vjp_outputs:
        _, gradient = compliance_gradient(_prepared(problem), rho)
        slope[: len(rho)] = float(cotangent_vector["compliance"]) * gradient
    return {"rho": slope}


def abstract_eval(abstract_inputs: InputSchema) -> dict[str, Any]:
    """Shapes of the outputs, without a solve."""
    return {"compliance": ShapeDType(shape=(), dtype="float32")}
