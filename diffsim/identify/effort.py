"""Effort of a diagnosis: options that a system advises and a user may change.

All budgets are counts of what is simulated, never of time: the same study has the same answer on
any machine, under any load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from diffsim.core.checked import checked
from diffsim.identify.jacobian import Jacobian

FIT_RTOL = 3e-4  # where a misfit is large no name explains it, and its last nats do not matter
KEEP_NATS = 4.0  # odds of 55 to 1: what a cause, or a wider band of an unknown one, must add
FIT_NATS = 0.02  # far below the 3 nats that separate two names


@checked
@dataclass(frozen=True)
class SearchSettings:
    """Effort of the search over sets of effects.

    Attributes:
        max_effects: Largest number of effects in one set.
        num_refits: Number of neighbors of the best set that are refitted per round.
        max_rounds: Largest number of moves to a better set.
        rival_nats: Error of linear evidence that is always allowed for: a set that is further
            behind the best one is not refitted [nats].
        linear_error: Further error of linear evidence, as a share of the misfit [-].
        scan_points: Largest number of sizes of effects with kinks that are tried before fits.
        scan_steps: Weighted steps (``SimModel.cost``) of these trials after which no further effect
            is tried.
        refit_steps: Weighted steps of all searches after which rivals of the best set keep their
            linear evidence; infinite: all that could win are refitted.
        law_steps: Weighted steps that laws which nobody listed may cost, and again the search with
            them; None: they share those of the search, where it leaves a fifth of these.
        num_starts: Largest number of starts of a fit that disappoints.
        unknown_steps: Number of Gauss-Newton steps of a set together with an unknown cause.
    """

    max_effects: int = 3
    num_refits: int = 4
    max_rounds: int = 8
    rival_nats: float = 6.0
    linear_error: float = 0.1
    scan_points: int = 400
    scan_steps: float = 150e6
    refit_steps: float = math.inf
    law_steps: float | None = math.inf
    num_starts: int = 3
    unknown_steps: int = 3


# a first answer fits as a full one does: looser fits named other causes of the arm and the starfish
FIRST_STEPS = 16e6  # weighted, of a first answer


@checked
@dataclass(frozen=True, kw_only=True)
class DiagnosisSettings:
    """Effort of a diagnosis; thresholds of the verdict are constants in ``diagnose``.

    Attributes:
        search: Effort of the search over sets of effects.
        jacobian: Method and step of the derivatives of predictions.
        workers: Number of threads over runs.
        accept_numerics: Whether to go on although the numerics gate fails.
        refine_budget: Cost of a simulation, over that with the model's own settings, up to which
            time step, mesh and tolerance are refined where the numerics gate fails; 1: never. The
            finest of a correction may cost a share of the search.
        first_mesh: Factor on the size of the model's own cells to begin with, where that pays.
        dear_steps: Weighted steps of a simulation of all fitted runs from which an answer begins
            with ``first_mesh``, and is told once what finer settings change (``Correction``)
            instead of simulating everything with them; infinite: never, but at the best set.
        plain_steps: Weighted steps after which a single fit ends where it is; infinite:
            at its end.
        again_steps: Deprecated since 1.1, without effect: no search is repeated up to a count.
        windows: Shares of each run that the plain model is fitted to first, ascending, where a fit
            to whole runs fails or ends far above what short ones leave; (): never.
        noise_rounds: Largest number of searches; the noise floor is estimated again after each.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    jacobian: Jacobian = field(default_factory=Jacobian)
    workers: int = 1
    accept_numerics: bool = False
    refine_budget: float = 8.0
    first_mesh: float = 1.0
    dear_steps: float = math.inf
    plain_steps: float = math.inf
    again_steps: float = math.inf
    windows: tuple[float, ...] = (0.25, 0.5)
    noise_rounds: int = 3
