"""A simulator as the diagnosis sees it: parameters and effects in, predicted channels out."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from threading import Lock
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from diffsim.core.checked import checked, checked_methods
from diffsim.identify.effect import Effect
from diffsim.identify.numerics import NumericalEffect, Numerics

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.line import DifferenceLine, ModelPoint
    from diffsim.identify.shape import MovingShape


@dataclass(frozen=True)
class Parameter:
    """A base parameter with a Gaussian prior.

    Fits work in the standardized coordinate q, prior q ~ N(0, 1): the value is value + sd q, or
    value exp(sd q) where ``log``, cut at the bounds.

    Attributes:
        name: Field-standard name, such as "youngs_modulus"; nuisances of one run are called
            "offset_x@run_3".
        value: Best guess beforehand, in ``unit``.
        sd: Standard deviation of the prior, in ``unit``; relative where ``log``.
        unit: SI unit, "-" if none.
        log: The logarithm is what is normally distributed; for positive quantities.
        lower, upper: Bounds of the value, in ``unit``.
        step: Longest step of a difference quotient, in ``unit``, where the record has edges that
            move with the value; not where ``log``.
        of_effect: Whether it is a number of an effect's formula (``Effect.shapes``) and does
            nothing without it.
        is_usual: Whether nobody stated it: a usual value, which no data sheet says.
    """

    name: str
    value: float
    sd: float
    unit: str = "-"
    log: bool = False
    lower: float = -math.inf
    upper: float = math.inf
    step: float = math.inf
    of_effect: bool = False
    is_usual: bool = False

    def __post_init__(self) -> None:
        if not math.isfinite(self.value) or not self.lower <= self.value <= self.upper:
            raise ValueError(
                f"parameter {self.name}: value {self.value:g} {self.unit} must be finite and "
                f"within [{self.lower:g}, {self.upper:g}]"
            )
        if not (math.isfinite(self.sd) and self.sd > 0.0):
            raise ValueError(f"parameter {self.name}: sd must be above 0, got {self.sd:g}")
        if self.log and self.value <= 0.0:
            raise ValueError(f"parameter {self.name} is logarithmic; its value must be above 0")

    @checked(kinds_only=True)
    def value_at(self, q: Tensor) -> Tensor:
        """Value [unit] at the standardized coordinate q."""
        raw = self.value * torch.exp(self.sd * q) if self.log else self.value + self.sd * q
        return raw.clamp(self.lower, self.upper)

    @checked(kinds_only=True)
    def coordinate_of(self, value: float) -> float:
        """Standardized coordinate of a value [unit]."""
        if self.log:
            return math.log(value / self.value) / self.sd
        return (value - self.value) / self.sd


class BaseValues:
    """Values of many base parameters at once: those without a logarithm in a few vector operations.

    Args:
        base: The base parameters, in the order of the coordinates.

    Attributes:
        low, high: Bounds of the standardized coordinates, (num_base,).
    """

    def __init__(self, base: Sequence[Parameter]):
        self.base = tuple(base)
        # tensors: a list is made into one by every indexing, which is dear with a thousand names
        self._linear = torch.tensor([i for i, p in enumerate(base) if not p.log], dtype=torch.long)
        self._logs = torch.tensor([i for i, p in enumerate(base) if p.log], dtype=torch.long)
        ranks = iter(range(len(self._linear)))
        #: index of each parameter, and its index among those without a logarithm or -1, by name
        self._places = {p.name: (i, -1 if p.log else next(ranks)) for i, p in enumerate(base)}
        widths = [p.sd for p in base if p.log]
        self._log_sd = torch.tensor(widths, dtype=torch.float64)
        rows = [(p.value, p.sd, p.lower, p.upper) for p in base if not p.log]
        table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 4)
        self._value, self._sd, self._lower, self._upper = table.unbind(-1)
        # of a logarithm zero is no bound
        has_low = [math.isfinite(p.lower) and not (p.log and p.lower <= 0.0) for p in base]
        self.low = np.array(
            [p.coordinate_of(p.lower) if h else -np.inf for p, h in zip(base, has_low, strict=True)]
        )
        self.high = np.array(
            [p.coordinate_of(p.upper) if math.isfinite(p.upper) else np.inf for p in base]
        )

    @property
    def names(self) -> Collection[str]:
        """Names of the parameters, in their order."""
        return self._places.keys()

    def raw(self, q: Tensor) -> Tensor:
        """(..., num_base) finite where all values are: linear ones, then factors of the others."""
        logs = torch.exp(self._log_sd * q.index_select(-1, self._logs))
        return torch.cat([self._linear_at(q), logs], dim=-1)

    def at(self, q: Tensor) -> Mapping[str, Tensor]:
        """Values [unit] by name, (...) each, at standardized coordinates (..., num_base)."""
        return _PointValues(self, q, self._linear_at(q))

    def one(self, name: str, q: Tensor, linear: Tensor) -> Tensor:
        """Value [unit] of one parameter, (...).

        Args:
            q: Standardized coordinates, (..., num_base).
            linear: Values of those without a logarithm there, (..., num_linear).
        """
        i, rank = self._places[name]
        return self.base[i].value_at(q.select(-1, i)) if rank < 0 else linear.select(-1, rank)

    def _linear_at(self, q: Tensor) -> Tensor:
        """(..., num_linear) values of those without a logarithm."""
        own = q.index_select(-1, self._linear)
        return (self._value + self._sd * own).clamp(self._lower, self._upper)


class _PointValues(Mapping[str, Tensor]):
    """Values of base parameters at a point, made when they are asked for: a study of many runs has
    hundreds, of which a run needs its own."""

    def __init__(self, values: BaseValues, q: Tensor, linear: Tensor):
        self._values, self._q, self._linear = values, q, linear

    def __getitem__(self, name: str) -> Tensor:
        return self._values.one(name, self._q, self._linear)

    def __contains__(self, name: object) -> bool:
        return name in self._values.names

    def __iter__(self) -> Iterator[str]:
        return iter(self._values.names)

    def __len__(self) -> int:
        return len(self._values.names)


class Scene(Protocol):
    """One run, ready to be simulated; systems add the hooks that their effects use."""

    def simulate(self) -> Tensor:
        """Predicted channels at the run's sample times, (num_samples, num_channels)."""
        ...


class Work(NamedTuple):
    """What was simulated, in counts: the same on every machine."""

    simulations: int  # predictions of one run at one point
    steps: int  # their weighted steps (``SimModel.cost``), derivatives included


NOTHING = Work(0, 0)


class Tally:
    """Work that was asked for; threads may count at once."""

    def __init__(self) -> None:
        self.count, self.steps, self._lock = 0, 0, Lock()

    def add(self, number: int, steps: int = 0) -> None:
        """Add simulations and their weighted steps."""
        with self._lock:
            self.count += number
            self.steps += steps

    @property
    def work(self) -> Work:
        """All that was counted so far."""
        with self._lock:
            return Work(self.count, self.steps)

    def since(self, before: Work) -> Work:
        """What was counted after some moment."""
        now = self.work
        return Work(now.simulations - before.simulations, now.steps - before.steps)


class RunPoints(NamedTuple):
    """A run that is to be predicted at one point, or at K.

    Attributes:
        run: Recorded run whose commands and times are simulated.
        q: Standardized base parameters, (num_base,) or (K, num_base).
        sizes: Size of each effect there in its unit, (num_components,) or (K, num_components).
    """

    run: Run
    q: Tensor
    sizes: Mapping[Effect, Tensor]


TOGETHER = 0.25  # of a simulation, that one more point or direction of a batch costs

Build = Callable[[Mapping[str, Tensor], "Run", Numerics], Scene]


@checked_methods
class SimModel:
    """A simulator with base parameters.

    Args:
        build: Function (values, run, numerics) -> scene of a run, from values of the base
            parameters by name.
        base: Everything imperfectly known: materials, gains, and nuisances of the set-up.
        name: Name of the simulator, for the report.
        batched: Whether scenes and effects take many points at once: then values may be (K,),
            sizes (K, num_components) and predictions (K, num_samples, num_channels).

    Attributes:
        prepared_q: Point that ``prepared_at`` made this model for, (num_base,) standardized; None
            where nothing is prepared.
        frame: What its setup takes from the runs of the study, such as labels and the magnitudes
            that sizes of effects mean by, in types that JSON has; a study with this ``frame`` makes
            causes that mean the same. Extended models are saved with it.
        run_cost: Weighted steps that a prediction of a run costs, however short. One is a step of
            a small system, about a microsecond of one core: ``benchmarks.step_costs``. Budgets
            count in these.
        step_cost: Weighted steps of one sample.
        mesh_power: By which power of a cell's size a sample gets cheaper; 0: there are no cells.
        cuts: Where runs are cut because two starts part, and how these part, by name of the run:
            time [s] and words for each place.
    """

    prepared_q: Tensor | None = None
    frame: Mapping[str, Any] = MappingProxyType({})
    run_cost: float = 250.0
    step_cost: float = 2.0
    mesh_power: float = 0.0
    cuts: Mapping[str, tuple[tuple[float, str], ...]] = MappingProxyType({})

    #: Whether effects at size zero need not act: nothing else changes, such as how it is stepped
    leaves_zeros = False
    #: Whether several runs are predicted quicker at once than one after the other
    joins_runs = False
    #: Whether something moves: what turns with a speed, as dry friction, makes edges of records
    moves = True
    #: Base parameters that are the strengths of all drives: times these, every mass, inertia and
    #: loss, too, the motion is the same; (): unknown, or one is no parameter
    drives: tuple[str, ...] = ()
    #: The body or vehicle of a scene as it is simulated; None: nothing is to be seen
    _shape_of_scene: Callable[[Any], MovingShape | None] | None = None

    def __init__(
        self,
        build: Build,
        base: Sequence[Parameter],
        name: str = "model",
        *,
        batched: bool = False,
    ):
        names = [p.name for p in base]
        if repeated := {n for n in names if names.count(n) > 1}:
            raise ValueError(f"base parameters repeat: {sorted(repeated)}")
        self.build, self.base, self.name, self.batched = build, tuple(base), name, batched
        self.values = BaseValues(self.base)
        self.simulations = Tally()

    def with_base(self, base: Sequence[Parameter]) -> SimModel:
        """The same simulator with further base parameters after its own."""
        made = copy(self)
        made.base, made.values = tuple(base), BaseValues(base)
        return made

    def with_shapes_of(self, effects: Sequence[Effect]) -> SimModel:
        """The same simulator, in which further numbers of effects are base parameters."""
        shapes = {name: shape for effect in effects for name, shape in effect.shapes.items()}
        if not shapes:
            return self
        more = [
            Parameter(
                name,
                s.value,
                s.sd,
                s.unit,
                lower=s.lower,
                upper=s.upper,
                of_effect=True,
                is_usual=True,
            )
            for name, s in shapes.items()
        ]
        return self.with_base((*self.base, *more))

    def cost(self, run: Run, numerics: Numerics | None = None) -> float:
        """Weighted steps of one prediction: what budgets count, the same on every machine.

        Args:
            run: Run that is simulated.
            numerics: Factors on time step, mesh and tolerance; None: the model's own.
        """
        n = numerics or Numerics()
        finer = n.time_step * n.mesh**self.mesh_power
        return self.run_cost + len(run.time_s) * self.step_cost / finer

    def note_simulations(self, run: Run, number: int, numerics: Numerics | None = None) -> None:
        """Count predictions of a run; of a batch all but the first are cheaper."""
        more = (TOGETHER if self.batched else 1.0) * (number - 1)
        self.simulations.add(number, round(self.cost(run, numerics) * (1.0 + more)))

    def note_derivatives(self, run: Run, number: int, numerics: Numerics | None = None) -> None:
        """Count the model's own derivatives of a prediction along some coordinates."""
        self.simulations.add(0, round(self.cost(run, numerics) * (1.0 + TOGETHER * number)))

    def predict(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Predicted channels of a run, (num_samples, num_channels).

        Args:
            run: Recorded run whose commands and times are simulated.
            q: Standardized base parameters, (num_base,) float64.
            sizes: Effects with their sizes [unit], (num_components,) each, applied in this order.
            numerics: Settings; the model's own if None.
        """
        physical, numerical = _split_effects(sizes)
        self.note_simulations(run, len(q) if q.ndim > 1 else 1, numerics)
        out = plain = self.scene(run, q, physical, numerics).simulate()
        for effect, size in numerical.items():
            if size.requires_grad or bool((size != 0.0).any()):
                finer = (numerics or Numerics()).refined(effect.refined)
                refined = self.predict(run, q, physical, finer)
                out = out + size[..., None] * (refined - plain)
        return out

    def predict_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Predictions at many points, (K, num_samples, num_channels): at once where ``batched``.

        Args:
            run: Recorded run whose commands and times are simulated.
            q: Standardized base parameters of K points, (K, num_base).
            sizes: Size of each effect at the K points, (K, num_components) in the effect's unit.
            numerics: Factors on time step, mesh and tolerance; None: the model's own.
        """
        if self.batched and (torch.is_grad_enabled() or not self.leaves_zeros):
            out = self.predict(run, q, sizes, numerics)
            # readings that nothing of these points enters are alike at all of them
            return out.expand(len(q), *out.shape[-2:])
        physical, numerical = _split_effects(sizes)
        self.note_simulations(run, len(q), numerics)
        out = plain = self.simulate_many(run, q, physical, numerics)
        for effect, size in numerical.items():
            if (rows := torch.nonzero(size[:, 0])[:, 0]).numel():
                finer = (numerics or Numerics()).refined(effect.refined)
                there = {e: s[rows] for e, s in physical.items()}
                change = self.predict_many(run, q[rows], there, finer) - plain[rows]
                out = out.index_add(0, rows, size[rows, :, None] * change)
        return out

    def left_of_readings(
        self, scene: Callable[[], Scene], change: sparse.csr_array
    ) -> sparse.csr_array:
        """What is left of changes of all readings where start states are fitted to the record.

        Args:
            scene: Makes the run at one point; not asked where nothing is fitted to a run.
            change: Of the readings, sample by sample, (num_samples * num_channels, K).
        """
        return change

    def scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Scene:
        """The run at one point, ready to be simulated; arguments as for ``predict``. Numerical
        effects act on predictions, in no scene."""
        values = self.values.at(q)
        scene = self.build(values, run, Numerics() if numerics is None else numerics)
        for effect, size in _split_effects(sizes)[0].items():
            scene = effect.act(scene, size, run, values)
        return scene

    def simulate_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Predictions as of ``predict_many``, without numerical effects; faster models override
        this."""
        if not self.batched:
            # of a table's points nearly all sizes are zero; derivatives need all of them
            every = torch.is_grad_enabled() or not self.leaves_zeros
            acting: list[dict[Effect, Tensor]] = [{} for _ in q]
            for effect, size in sizes.items():
                rows = range(len(q)) if every else torch.nonzero(size.any(-1))[:, 0].tolist()
                for k in rows:
                    acting[k][effect] = size[k]
            scenes = [self.scene(run, *at, numerics) for at in zip(q, acting, strict=True)]
            return torch.stack(self.simulate_scenes(scenes))
        rows, scenes = self._group_scenes(run, q, sizes, numerics)
        return joined(rows, [scene.simulate() for scene in scenes])

    def _group_scenes(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        numerics: Numerics | None = None,
    ) -> tuple[list[list[int]], list[Any]]:
        """Points at once where the same effects act: each is as if no other effect were known, and
        a table costs as much as it has points. Arguments as for ``simulate_many``.

        Returns:
            The points of each scene by index, and the scenes.
        """
        groups: dict[tuple[Effect, ...], list[int]] = {}
        acts = {e: (s != 0.0).any(-1).tolist() for e, s in sizes.items()}
        for k in range(len(q)):
            groups.setdefault(tuple(e for e, there in acts.items() if there[k]), []).append(k)
        scenes = [
            self.scene(run, q[rows], {e: sizes[e][rows] for e in effects}, numerics)
            for effects, rows in groups.items()
        ]
        return list(groups.values()), scenes

    @checked(kinds_only=True)
    def predict_each(
        self, asked: Sequence[RunPoints], numerics: Numerics | None = None
    ) -> list[Tensor]:
        """Predictions of several runs, each at its own points; models that have a faster way
        override this, and say so by ``joins_runs``.

        Args:
            asked: Runs with their points.
            numerics: Factors on time step, mesh and tolerance; None: the model's own.

        Returns:
            As of ``predict`` where a run is asked at one point, else as of ``predict_many``.
        """
        return [
            (self.predict if a.q.ndim == 1 else self.predict_many)(a.run, a.q, a.sizes, numerics)
            for a in asked
        ]

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """Predictions of several scenes of one run; models that have a faster way override this."""
        return [scene.simulate() for scene in scenes]

    def tangents(
        self,
        run: Run,
        at: ModelPoint,
        lines: Sequence[DifferenceLine],
        numerics: Numerics | None = None,
    ) -> tuple[Tensor, Tensor] | None:
        """The prediction of a run and its derivatives, for models quicker than their simulations.

        Args:
            run: Recorded run whose commands and times are simulated.
            at: Point to differentiate at.
            lines: K smooth coordinates to differentiate along.
            numerics: Factors on time step, mesh and tolerance; None: the model's own.

        Returns:
            (num_samples, num_channels) and (K, num_samples, num_channels); None: difference
            simulations instead.
        """
        return None

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """The body or vehicle as channels show it, where they tell its pose.

        Args:
            run: Run that they belong to.
            channels: Measured or predicted, (num_samples, num_channels).

        Returns:
            None where they do not, or where nothing is to be seen.
        """
        return None

    def shape_at(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> MovingShape | None:
        """The body or vehicle as it is simulated, for models that know more of it than channels.

        Arguments as for ``predict``; None where nothing is to be seen.
        """
        if self._shape_of_scene is None:
            return None
        with torch.no_grad():
            return self._shape_of_scene(self.scene(run, q, sizes, numerics))

    def prepared_at(self, q: Tensor, runs: Sequence[Run] = ()) -> SimModel:
        """The model with whatever it prepares once prepared again at these base coordinates.

        Args:
            q: Standardized base parameters, (num_base,).
            runs: Runs that were fitted, which may need no other preparation; (): a saved model
                that was prepared is so again.

        Returns:
            The model itself where nothing is prepared.
        """
        return self

    def shortened(self, runs: Sequence[Run]) -> SimModel | None:
        """The model with shorter windows of its own, where it cuts runs and starts anew in each.

        Args:
            runs: Runs whose windows are too long.

        Returns:
            None where windows are as short as they may be, or there are none.
        """
        return None

    def short_windows(self, runs: Sequence[Run]) -> Mapping[str, float]:
        """Length of the windows [s] by run, where the model's own windows had to be short."""
        return {}

    def at_prior(self) -> Tensor:
        """Standardized coordinates of the best guess, (num_base,)."""
        return torch.zeros(len(self.base), dtype=torch.float64)


def _split_effects(
    sizes: Mapping[Effect, Tensor] | None,
) -> tuple[dict[Effect, Tensor], dict[NumericalEffect, Tensor]]:
    """Effects of the scene and effects of its prediction, apart."""
    given = sizes or {}
    numerical = {e: s for e, s in given.items() if isinstance(e, NumericalEffect)}
    return {e: s for e, s in given.items() if e not in numerical}, numerical


def joined(rows: Sequence[Sequence[int]], parts: Sequence[Tensor]) -> Tensor:
    """Predictions of scenes in the order of their points, (K, num_samples, num_channels).

    Args:
        rows: Points of each scene by index.
        parts: Its predictions; readings that nothing of these points enters are alike at all.
    """
    given = zip(rows, parts, strict=True)
    found = torch.cat([part.expand(len(own), *part.shape[-2:]) for own, part in given])
    return found[np.argsort([k for own in rows for k in own])]


def has_tangents(model: SimModel) -> bool:
    """Whether a model differentiates its predictions itself (a method ``tangents`` of its own)."""
    return getattr(type(model), "tangents", None) is not getattr(SimModel, "tangents", None)


def slopes_are_simulated(model: SimModel) -> bool:
    """Whether each slope takes simulations of its own: neither a batch nor tangents give all."""
    return not (model.batched or has_tangents(model))
