"""Keys of ``model: {system: bench}`` beyond those that systems of formulas share."""

from __future__ import annotations

from pydantic import Field

from diffsim.core.schema import Part
from diffsim.systems.ode.keys import Formula


class Law(Part):
    """A definition that is a law y = f(x); opens what may be wrong with its shape."""

    name: str = Field(description="Name of the definition")
    of: Formula = Field(description="What it is a law of, x: an input or a formula")
    unit: str = Field("-", description="Unit of y")
    of_unit: str = Field("-", description="Unit of x")
    per: str | None = Field(
        None,
        description="Fact of the runs, such as propeller: sizes for each value of it, beside a "
        "common one that also holds for values that were never fitted",
    )
    sweeps: bool = Field(
        False, description="Whether x was swept up and down, so that hysteresis may be seen"
    )
