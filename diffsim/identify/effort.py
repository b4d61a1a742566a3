"""How much a diagnosis computes: options that a system advises and a user may change."""

from __future__ import annotations

from dataclasses import dataclass, field

from diffsim.identify.jacobian import Jacobian


@dataclass(frozen=True)
class SearchSettings:
    """Effort.

    Attributes:
        max_effects: In one set.
        num_refits: Neighbours refitted per round.
        max_rounds: Of moving to a better set.
        rival_nats: What linear evidence puts further behind the best set is not refitted.
        linear_error: Share of the misfit [nats] by which linear evidence may be wrong beyond that.
        unknown_steps: Gauss-Newton steps of a set together with an unknown cause.
    """

    max_effects: int = 3
    num_refits: int = 4
    max_rounds: int = 8
    rival_nats: float = 6.0
    linear_error: float = 0.1
    unknown_steps: int = 3


@dataclass(frozen=True, kw_only=True)
class DiagnosisSettings:
    """Effort and choices; the thresholds of the verdict are constants of ``decide``.

    Attributes:
        search: Effort of the search.
        jacobian: How to differentiate.
        workers: Threads over runs.
        accept_numerics: Go on although the numerics gate fails.
        noise_rounds: At most; the floor is estimated again after each.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    jacobian: Jacobian = field(default_factory=Jacobian)
    workers: int = 1
    accept_numerics: bool = False
    noise_rounds: int = 3
