"""Effort of a diagnosis: options that a system advises and a user may change."""

from __future__ import annotations

from dataclasses import dataclass, field

from diffsim.identify.jacobian import Jacobian


@dataclass(frozen=True)
class SearchSettings:
    """Effort of the search over sets of effects.

    Attributes:
        max_effects: Effects in one set, at most.
        num_refits: Neighbors refitted per round.
        max_rounds: Moves to a better set, at most.
        rival_nats: Distance from the best set, by linear evidence, from which no set is refitted.
        linear_error: Error of linear evidence beyond that, as a share of the misfit [nats].
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
    """Effort and choices; the thresholds of the verdict are constants of ``diagnose.judge``.

    Attributes:
        search: Effort of the search over sets of effects.
        jacobian: Method and step of the derivatives.
        workers: Number of threads over runs.
        accept_numerics: Whether to go on although the numerics gate fails.
        noise_rounds: Searches at most; the noise floor is estimated again after each.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    jacobian: Jacobian = field(default_factory=Jacobian)
    workers: int = 1
    accept_numerics: bool = False
    noise_rounds: int = 3
