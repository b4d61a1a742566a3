"""What co-design could not do."""

from __future__ import annotations

from diffsim.core.errors import DiffsimError


class CoDesignError(DiffsimError):
    """No design, or none that hovers, lies in the space searched.

    Attributes:
        residual: Distance of the best candidate from feasibility, in the unit that the message
            names.
    """

    def __init__(self, message: str, *, residual: float):
        super().__init__(message)
        self.residual = residual
