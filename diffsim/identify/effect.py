"""A candidate cause: a differentiable term with an amplitude that is zero in the plain model.

Sizes have a heavy-tailed prior: a standardized coordinate x ~ N(0, 1) and a scaled size u(x), the
size over ``PRIOR_WIDTH`` typical sizes. u = sinh(TAIL x) / TAIL has slope one at zero, so small
sizes are as good as normal. Its tails are nearly log-uniform: ten times the typical size costs 2
nats, a hundred times 6. Simulated records are nearly linear in u, not in x.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.data.study import Run, Study
from diffsim.identify.law import Shape
from diffsim.identify.locate import Course, Proposal

KINDS = ("force", "actuator", "sensor", "material", "environment", "numerical")
Real = TypeVar("Real", Array, Tensor)
PRIOR_WIDTH = 1.5  # slope of a size at zero by its coordinate, in typical sizes
TAIL = 1.5
Apply = Callable[[Any, Tensor, Run], Any]
Needs = Callable[[Study], "str | None"]


def is_of_run(component: str) -> bool:
    """Whether a component acts in one run alone ("@run_3"), as nuisances are called."""
    return component.startswith("@")


def needs_nothing(study: Study) -> str | None:
    """Accept every study."""
    return None


@dataclass(frozen=True, kw_only=True, eq=False)
class Locator:
    """How an effect finds where it lies."""

    course: Effect  # effect whose components are values at the knots, in the order of ``times``
    times: Array  # time of each knot in the runs' clock, (K,) [s]
    acts_in: Callable[[Run], bool]  # whether the effect acts in a run
    # places worth a simulation, best first, given what any course would gain
    propose: Callable[[Course], Sequence[Proposal]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """One cause, named by its form; physical causes that share the form are its aliases.

    Attributes:
        name: Field-standard name, such as "linear_drag"; it has one unit in all libraries.
        family: Effects of one family are alternatives of each other, such as "damping".
        kind: Where the effect enters, one of ``KINDS``.
        unit: SI unit of every component, "-" if none.
        typical: Size that would be no surprise [unit]: a scale, no bound. The prior of a component
            is 1.5 typical sinh(1.5 x) / 1.5 with x ~ N(0, 1), and x >= 0 unless ``signed``: ten
            times the typical size costs 2 nats.
        apply: Function (scene, size, run) -> scene with the effect at this size. The scene is what
            the model's ``build`` made for the run; size has the shape (..., num_components)
            [unit]; at zero it must be the scene itself.
        form: What the effect does at a given size, in a sentence.
        signed: Whether components may be negative.
        components: Names of the amplitudes, one or more (a vector enters as one block).
        smooth: False where the response has a kink at zero: then a secant at a tenth of the typical
            size stands for the derivative, and sizes over decades are tried before a fit.
        scanned: Whether its size is scanned over decades before a descent although it is smooth: a
            descent from zero may end in another valley. Effects with a kink always are.
        tries: Multiples of the typical size that a scan tries; empty: over decades.
        masks: Names of effects that hide this one, or are hidden by it, such as slack and a rate
            limit: their sizes are tried together, and they enter sets as a pair. "rate_limit"
            stands for "rate_limit_of_force" too.
        also_looks_like: Physical causes and other forms that data may not distinguish from it.
        words: Function of a size that says it in plain words where its number would not be
            understood, such as "a speed limit near 100 mm/s"; None: name and size.
        says: The same with the values of the base parameters by name, for causes that these place
            in time; it comes before ``words``.
        locate: How it finds where it lies in time, for causes of limited duration; None: it acts
            always.
        needs: Function of a study: what it lacks for the effect to be judged; None if nothing.
        shown_unit: Unit in which a user reads the size, such as "mm"; None: ``unit``.
        shown_times: What a size is multiplied by to be read in it; None: as the units say.
        shown_power: Power of the size that is read: -1 where it is stated per what is read.
        price: Nats that the choice of its form among others costs, beside that of its family.
        members: Names of the causes that it is with one size, such as delays of commands; empty:
            it is of one member, or one cause in itself.
        shapes: Further numbers of its formula, such as a wave number, by name of the base
            parameter that each is. ``apply`` gets their values after the components; they do
            nothing without it.
    """

    name: str
    family: str
    kind: str
    unit: str
    typical: float
    apply: Apply
    form: str = ""
    signed: bool = True
    components: tuple[str, ...] = ("size",)
    smooth: bool = True
    scanned: bool = False
    tries: tuple[float, ...] = ()
    masks: tuple[str, ...] = ()
    also_looks_like: tuple[str, ...] = ()
    words: Callable[[float], str] | None = None
    says: Callable[[float, Mapping[str, float]], str] | None = None
    locate: Locator | None = None
    needs: Needs = needs_nothing
    shown_unit: str | None = None
    shown_times: float | None = None
    shown_power: int = 1
    price: float = 0.0
    members: tuple[str, ...] = ()
    shapes: Mapping[str, Shape] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_choice(f"effect {self.name}: kind", self.kind, KINDS)
        if not self.typical > 0.0:
            raise ValueError(f"effect {self.name}: typical must be above 0, got {self.typical:g}")

    def act(self, scene: Any, size: Tensor, run: Run, values: Mapping[str, Tensor]) -> Any:
        """The scene with the effect at a size.

        Args:
            scene: What the model's ``build`` made for the run.
            size: Size of the effect, (..., num_components) [unit].
            run: Run that is simulated.
            values: Values of the base parameters by name, (...) each.
        """
        if self.shapes:
            own = [values[name].expand(size.shape[:-1]) for name in self.shapes]
            size = torch.cat([size, torch.stack(own, -1)], -1)
        return self.apply(scene, size, run)


def effect_coordinates(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Names of the components; the effect's own where it has only one."""
    return tuple(
        e.name if len(e.components) == 1 else f"{e.name}.{c}" for e in effects for c in e.components
    )


def touches(name: str, run: Run) -> bool:
    """Whether a coordinate acts in a run: "offset@run_3" acts in run_3 only, "drag[frame=A]" where
    the run's setup says so."""
    if name.endswith("]") and "=" in name:
        key, _, label = name[name.rindex("[") + 1 : -1].partition("=")
        return key not in run.setup or str(run.setup[key]) == label
    return "@" not in name or name.rsplit("@", 1)[1] == run.name


def scaled_at(x: Real) -> Real:
    """Size over ``PRIOR_WIDTH`` typical sizes at standardized coordinates x."""
    if isinstance(x, Tensor):
        return torch.sinh(TAIL * x) / TAIL
    return np.asarray(np.sinh(TAIL * x) / TAIL)


def coordinate_of(u: Real) -> Real:
    """Standardized coordinates of scaled sizes, the inverse of ``scaled_at``."""
    if isinstance(u, Tensor):
        return torch.asinh(TAIL * u) / TAIL
    return np.asarray(np.arcsinh(TAIL * u) / TAIL)


def stretch_at(x: Array) -> Array:
    """Derivative of the scaled size by its standardized coordinate."""
    return np.asarray(np.cosh(TAIL * x))


def precision_at(u: Array) -> Array:
    """Precision w of the normal prior in u, centered at 0, that stands for the heavy-tailed one.

    1/2 w u^2 lies above x(u)^2 / 2 + const and touches it at u, as that is concave in u^2. Solving
    with it again and again lowers |r|^2 + |x|^2 in every step.
    """
    x = coordinate_of(u)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(u == 0.0, 1.0, x / (u * stretch_at(x)))
