"""Tossed bodies as a model: start states of all tosses are fitted away, not searched for.

A start state of 12: position, roll-pitch-yaw, velocity, body rates, world z up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial

import torch
from scipy import sparse
from torch import Tensor

from diffsim.causes.channel_groups import delays_of
from diffsim.causes.scene import Instruments, Scene, grid_of
from diffsim.core.memo import Memo, memo_field
from diffsim.data.study import Channel, Run
from diffsim.identify import model as identify_model
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.shape import MovingShape
from diffsim.identify.starts import left_by_starts
from diffsim.systems.description import BaseParameters
from diffsim.systems.rigid_body.figure import figure_of
from diffsim.systems.rigid_body.layout import PoseLayout
from diffsim.systems.rigid_body.toss import Mass, Tosses, added


@dataclass(frozen=True, eq=False)
class TossSetup:
    """What all tosses of a study have in common."""

    # quantities of the description: restitution, friction, gravity, ground, edges
    parameters: BaseParameters
    mass: Mass  # what is known of the body's mass
    layout: PoseLayout  # what the channels show


@dataclass(frozen=True, eq=False)
class TossTable:
    """All tosses of a study and how their start states follow from the records."""

    thrown: TossSetup  # what the tosses have in common
    tosses: Tosses  # all tosses, side by side
    shooting: TossShooting  # fit of the start states of all tosses
    place: Mapping[str, int]  # index of each run in ``tosses``, by name of the run
    # the last prediction of all tosses by its arguments: they are flown at once, and asked for one
    # by one
    latest: Memo[Tensor] = memo_field(1)

    def predict(
        self,
        run: Run,
        values: Mapping[str, Tensor],
        terms: Mapping[str, Tensor],
        instruments: Instruments,
    ) -> Tensor:
        """(K, length, num_channels) of one toss with the best start states."""
        index = self.place[run.name]
        given = [*values.values(), *terms.values()]
        if any(v.requires_grad for v in given) or not instruments.is_empty:
            return self._predict_alone(run, values, terms, instruments)
        key = (*map(str.encode, terms), *(v.numpy().tobytes() for v in given))
        every = self.latest(
            key, lambda: self._profile_starts(self.tosses, self.shooting, values, terms)
        )
        return every[:, index]

    def _profile_starts(
        self,
        tosses: Tosses,
        shooting: TossShooting,
        values: Mapping[str, Tensor],
        terms: Mapping[str, Tensor],
    ) -> Tensor:
        """(K, num_tosses, length, num_channels) with the best start states."""
        many = max(v.numel() for v in (*values.values(), *terms.values()))
        thrown = self.thrown
        return shooting.profile(
            lambda start: tosses.fly(start, values, terms, thrown.mass, thrown.layout), many
        )

    def _predict_alone(
        self,
        run: Run,
        values: Mapping[str, Tensor],
        terms: Mapping[str, Tensor],
        instruments: Instruments,
    ) -> Tensor:
        """(K, length, num_channels) of one toss as instruments show it."""
        index, whole, thrown = self.place[run.name], self.shooting, self.thrown
        toss = self.tosses.only(index)
        own = TossShooting(*(getattr(whole, f.name)[index : index + 1] for f in fields(whole)))
        grid, count = grid_of(run), len(run.time_s)

        def show(start: Tensor) -> Tensor:
            fly = partial(toss.fly, start, values, terms, thrown.mass, thrown.layout)
            shown = fly()
            for channels, delay in delays_of(instruments.clocks).items():
                places = torch.tensor(channels)
                shown = shown.index_copy(-1, places, fly(delay)[..., places])
            read = instruments.read(shown[:, 0, :count], grid)
            return torch.cat([read, shown[:, 0, count:]], 1)[:, None]

        points = [v.numel() for v in (*values.values(), *terms.values())]
        num_read = instruments.num_points(run.measured.shape[1])
        return own.profile(show, max([*points, num_read]))[:, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class TossScene(Scene):
    """One toss; what causes add is zero until they do."""

    run: Run  # recorded toss
    table: TossTable  # all tosses of the study with their start states

    def simulate(self) -> Tensor:
        """(..., num_samples, num_channels) with the best start state."""
        values = {name: v for name, v in self.numbers.items() if name not in self.zeros}
        terms = {name: v for name, v in self.numbers.items() if name in self.zeros}
        out = self.table.predict(self.run, values, terms, self.instruments)
        out = out[:, : len(self.run.time_s)]
        wide = any(v.ndim for v in self.numbers.values())
        return out if wide or self.instruments.num_points(out.shape[-1]) else out[0]


TOSS, SAMPLE = 2000.0, 16.0  # weighted steps of a toss and of its samples, starts fitted anew


class TossModel(SimModel):
    """A tossed body; start states profiled at ``at``.

    Args:
        runs: Tosses of the study, as ``windows`` cut them.
        thrown: What the tosses have in common.
        at: Values of the base parameters where start states are linearized; the prior if None.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        channels: Sequence[Channel],
        thrown: TossSetup,
        at: Mapping[str, Tensor] | None = None,
    ):
        base = thrown.parameters.base
        self.runs, self.channels, self.thrown = tuple(runs), tuple(channels), thrown
        start = at or {p.name: torch.tensor(p.value, dtype=torch.float64) for p in base}
        known = thrown.parameters.in_run(start, self.runs[0])
        table = _prepare_table(self.runs, self.channels, thrown, known)

        def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> TossScene:
            return TossScene(
                grid=grid_of(run),
                numbers=thrown.parameters.in_run(values, run),
                zeros=added(),
                run=run,
                table=table,
            )

        super().__init__(build, base, "tossed body", batched=True)
        self.run_cost, self.step_cost = TOSS, SAMPLE

    def predict_many(self, run, q, sizes=None, numerics=None):  # type: ignore[no-untyped-def]
        """Predictions at many points; without parameters one serves for all."""
        out = super().predict_many(run, q, sizes, numerics)
        return out if out.ndim == 3 else out.expand(len(q), *out.shape)

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """The box at the poses that channels show, where they show them."""
        scene = self.scene(run, self.at_prior())
        assert isinstance(scene, TossScene)
        if not self.thrown.mass.has_corners:
            return None
        values = scene.numbers
        edges = [values["edge" if "edge" in values else f"edge_{a}"] for a in "xyz"]
        return figure_of(self.thrown.layout, torch.stack(edges), channels)

    def left_of_readings(
        self, scene: Callable[[], identify_model.Scene], change: sparse.csr_array
    ) -> sparse.csr_array:
        """As of ``SimModel``: the toss's start state takes in what it can."""
        made = scene()
        assert isinstance(made, TossScene)
        shooting, index = made.table.shooting, made.table.place[made.run.name]
        own = slice(index, index + 1)
        return left_by_starts(change, shooting.tangent[own], shooting.gain[own])

    def num_fitted_inside(self, run: Run) -> int:
        """Numbers that are fitted to each run inside: its start state."""
        return 12

    def prepared_at(self, q: Tensor, runs: Sequence[Run] = ()) -> SimModel:
        """Start states linearized at the values of these coordinates."""
        values = {p.name: p.value_at(q[i]) for i, p in enumerate(self.base)}
        made = TossModel(self.runs, self.channels, self.thrown, values)
        made.frame = self.frame
        return made.with_base(self.base)


def _prepare_table(
    runs: Sequence[Run],
    channels: Sequence[Channel],
    thrown: TossSetup,
    values: Mapping[str, Tensor],
) -> TossTable:
    tosses = Tosses.of(runs)
    sd = torch.tensor([c.sd for c in channels], dtype=torch.float64)
    count = len(runs)

    def flown(start: Tensor) -> Tensor:
        states = start.reshape(-1, count, 12)
        return tosses.fly(states, values, {}, thrown.mass, thrown.layout).flatten(0, 1)

    start = tosses.start
    for _ in range(2):  # once more from better start states
        prepared = TossShooting.prepare(flown, start, tosses.measured, sd)
        left = (tosses.measured - flown(start)).nan_to_num(0.0)
        start = start + (prepared.gain @ left.reshape(count, -1, 1))[..., 0]
    shooting = TossShooting.prepare(flown, start, tosses.measured, sd)
    return TossTable(thrown, tosses, shooting, {r.name: i for i, r in enumerate(runs)})


# What is known of a start state beyond its first guess: hardly anything [m, rad, m/s, rad/s].
_SPREAD = torch.tensor([0.3] * 3 + [0.2] * 3 + [1.0] * 3 + [1.0] * 3, dtype=torch.float64)
_NUDGE = 1e-4 * _SPREAD / _SPREAD.max()
_CORRECTIONS = 2


@dataclass(frozen=True, eq=False)
class TossShooting:
    """Windows of one run, and how their initial states follow from what was measured.

    The initial states d (departures from the first guess) minimize
    |W (measured - predicted(d))|^2 + |d / spread|^2 by Gauss-Newton with the tangents of the model
    at its prior; they are then a smooth function of all other parameters. The prediction is the
    profile over d: misfit that an initial state can explain is no evidence for anything.
    """

    start: Tensor  # first guess, (num_windows, 12)
    measured: Tensor  # (num_windows, length, num_channels), zero where nothing was recorded
    tangent: Tensor  # d predicted / d start, (num_windows, length * num_channels, 12)
    gain: Tensor  # misfit to states, (num_windows, 12, length * num_channels)

    @classmethod
    def prepare(
        cls, predict: Callable[[Tensor], Tensor], start: Tensor, measured: Tensor, sd: Tensor
    ) -> TossShooting:
        """Tangents by central differences.

        Args:
            predict: Starts (n * num_windows, 12), windows fastest, -> channels
                (n * num_windows, length, num_channels).
            start: First guess, (num_windows, 12).
            measured: (num_windows, length, num_channels), NaN where nothing was recorded.
            sd: Noise of the channels, (num_channels,).
        """
        windows, length, channels = measured.shape
        nudges = torch.diag(_NUDGE)
        moved = torch.cat([start + s * n for n in nudges for s in (1.0, -1.0)])
        with torch.no_grad():
            there = predict(moved).reshape(12, 2, windows, length * channels)
        tangent = (there[:, 0] - there[:, 1]) / (2.0 * _NUDGE[:, None, None])
        tangent = tangent.permute(1, 2, 0).contiguous()
        weight = (torch.isfinite(measured) / sd**2).reshape(windows, -1, 1)
        normal = tangent.mT @ (weight * tangent) + torch.diag(_SPREAD**-2)
        gain = torch.linalg.solve(normal, (weight * tangent).mT)
        return cls(start, measured.nan_to_num(0.0), tangent, gain)

    def profile(self, predict: Callable[[Tensor], Tensor], many: int) -> Tensor:
        """Predictions with the best initial states.

        Args:
            predict: Starts (many, num_windows, 12) -> channels of the same leading axes.
            many: Number of models that ``predict`` flies at once.

        Returns:
            (many, num_windows, length, num_channels).
        """
        windows, length, channels = self.measured.shape
        # models side by side as columns: gains are then read once, not once for each model
        change = torch.zeros(windows, 12, many, dtype=torch.float64)
        measured = self.measured.reshape(windows, -1, 1)
        for k in range(_CORRECTIONS + 1):
            here = predict(self.start + change.permute(2, 0, 1))
            here = here.reshape(many, windows, -1).permute(1, 2, 0)
            better = self.gain @ (measured - here + self.tangent @ change)
            if k == _CORRECTIONS:
                here = here + self.tangent @ (better - change)
            change = better
        return here.permute(2, 0, 1).reshape(many, windows, length, channels)
