"""TQC of sb3-contrib (Kuznetsov et al., ICML 2020): SAC with critics of quantiles.

The largest quantiles of all critics together are dropped from their targets, which keeps values
from being overestimated. All else is as in ``SacLearner``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_contrib import TQC

from diffsim.core.checked import checked
from diffsim.learn.sac import SacLearner, SacOptions
from diffsim.learn.setup import Setup


@checked
@dataclass(frozen=True)
class TqcOptions(SacOptions):
    """Options of ``TqcLearner``: those of SAC, and one of its own.

    Attributes:
        drop: Quantiles dropped per critic, of 25.
    """

    drop: int = 2


class TqcLearner(SacLearner):
    """sb3-contrib's TQC, one round of collecting and training per update.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    algorithm: type[Any] = TQC

    @checked
    def __init__(self, setup: Setup, options: TqcOptions | None = None):
        super().__init__(setup, options or TqcOptions())

    def _extra(self) -> dict[str, Any]:
        return {"top_quantiles_to_drop_per_net": self.options.drop}
