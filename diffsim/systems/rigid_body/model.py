"""A tossed cube: flight, impact of the first corner, flight; and the height at which it rests.

Plain: gravity, Coulomb friction, restitution, level ground at z = 0. In flight a cube turns at
constant rate about a fixed axis (its inertia is the same about all), so that everything is in
closed form: no time step. Each toss's start state is profiled out (``copter.shooting``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.core.rotation import (
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_product,
    rotate_by_quaternion,
)
from diffsim.data.importers.cube_toss import CORNERS, TWIST
from diffsim.data.study import Channel, Run
from diffsim.identify import Parameter
from diffsim.identify.model import Numerics, SimModel
from diffsim.systems.rigid_body.impact import impulse
from diffsim.systems.rigid_body.shooting import Shooting

GRAVITY = 9.81
HALF_WIDTH = 0.0524
NEWTON_STEPS = 6
SHORTEST = 1e-9  # [s] of a contact: instant
#: Terms that effects may add, with their number of components.
TERMS = {
    "length_scale": 1,
    "clock_scale": 1,
    "gravity": 3,
    "drag": 1,
    "quadratic_drag": 1,
    "spin_drag": 1,
    "ground_height": 1,
    "ground_slope": 2,
    "half_width": 1,
    "center": 3,
    "contact_time": 1,
    "smoothing": 1,
    "restitution_slope": 1,
    "rebound": 1,
    "friction_slope": 1,
    "inertia": 1,
}
REFERENCE_SPEED = 1.0  # [m/s] where the slopes of restitution and friction do nothing


@dataclass(frozen=True, eq=False)
class Tosses:
    """Several tosses side by side, padded to the longest.

    Attributes:
        time_s: (num_tosses, length) from 0; padded by its last frame.
        corner: (num_tosses, 3) the one that hits first, entries 1 or -1.
        touch_s: (num_tosses, 1) when it is near the board.
        turn: (num_tosses, 4) first quaternion, scalar part first.
        hits: (num_tosses, 1) 1 where the record goes on through the impact, else 0.
        measured: (num_tosses, length, 8), NaN in the padding.
        start: (num_tosses, 12) first guess: position, turn, velocity, body rates.
    """

    time_s: Tensor
    corner: Tensor
    touch_s: Tensor
    turn: Tensor
    hits: Tensor
    measured: Tensor
    start: Tensor

    @classmethod
    def of(cls, runs: Sequence[Run]) -> Tosses:
        """From recordings with the start values and the corner in their ``setup``."""
        length = max(len(r.time_s) for r in runs)
        times, poses = [], []
        for run in runs:
            more = length - len(run.time_s)
            times.append(np.pad(run.time_s - run.time_s[0], (0, more), mode="edge"))
            poses.append(np.pad(run.measured, ((0, more), (0, 0)), constant_values=np.nan))
        measured = torch.from_numpy(np.stack(poses))
        turn = measured[:, 0, 3:7]
        twist = torch.tensor([[r.setup[f"start_{c}"] for c in TWIST] for r in runs]).double()
        first = torch.cat([measured[:, 0, :3], torch.zeros_like(twist[:, :3]), twist], -1)
        return cls(
            torch.from_numpy(np.stack(times)),
            torch.from_numpy(CORNERS[[int(r.setup["corner"]) for r in runs]]),
            torch.tensor([[r.setup["touch_s"] - r.time_s[0]] for r in runs]).double(),
            turn / turn.norm(dim=-1, keepdim=True),
            torch.tensor([[r.setup["hits"]] for r in runs]).double(),
            measured,
            first,
        )

    def only(self, index: int) -> Tosses:
        """A copy with one of the tosses."""
        return Tosses(*(getattr(self, f.name)[index : index + 1] for f in fields(self)))

    def fly(
        self, start: Tensor, values: Mapping[str, Tensor], terms: Mapping[str, Tensor]
    ) -> Tensor:
        """Position [m], quaternion, height at rest [m], (K, num_tosses, length, 8).

        Args:
            start: Start states of K points, (K, num_tosses, 12).
            values: restitution and friction, (K,) or ().
            terms: Sizes of what effects add, (K, num_components) or (num_components,); ``TERMS``.
        """
        k = len(start)
        get = {name: _sized(terms, name, k) for name in TERMS}
        e, mu = (values[n].expand(k)[:, None] for n in ("restitution", "friction"))
        stretch = 1.0 + get["clock_scale"]
        time = self.time_s * stretch  # (K, R, n)
        x0, turn, v0, rates = start.split(3, -1)
        q0 = quaternion_product(self.turn, quaternion_from_rotation_vector(turn))
        gravity = get["gravity"] + torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
        middle = v0 + 0.5 * gravity * time[..., -1:]
        drag = get["drag"] + get["quadratic_drag"] * middle.norm(dim=-1, keepdim=True)
        spin = get["spin_drag"]
        arm_body = self.corner * HALF_WIDTH * (1.0 + get["half_width"]) - get["center"]
        slope = get["ground_slope"]

        def at(t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """Gap of the corner, its velocity, and its arm at times (K, R, 1)."""
            x, v = _ballistic(x0, v0, gravity, drag, t)
            q = quaternion_product(q0, quaternion_from_rotation_vector(rates * _slowed(t, spin)))
            arm = rotate_by_quaternion(q, arm_body)
            rate = rotate_by_quaternion(q, rates * (1.0 - spin * t))
            place, speed = x + arm, v + torch.linalg.cross(rate, arm)
            level = get["ground_height"] + (place[..., :2] * slope).sum(-1, True)
            return place[..., 2:] - level, speed, arm

        hit = self.touch_s * stretch
        for _ in range(NEWTON_STEPS):
            gap, speed, _ = at(hit)
            hit = hit - gap / speed[..., 2:].clamp(max=-0.1)
        _, speed, arm = at(hit)
        inertia = 2.0 / 3.0 * HALF_WIDTH**2 * (1.0 + get["inertia"])
        e = e * torch.exp(get["restitution_slope"][..., 0] * (-speed[..., 2] - REFERENCE_SPEED))
        slip = speed[..., :2].square().sum(-1).clamp(min=1e-12).sqrt()
        mu = mu * torch.exp(get["friction_slope"][..., 0] * (slip - REFERENCE_SPEED))
        kick = impulse(speed, arm, inertia[..., 0], e, mu, get["rebound"][..., 0])
        q_hit = quaternion_product(q0, quaternion_from_rotation_vector(rates * _slowed(hit, spin)))
        twist = rotate_by_quaternion(
            quaternion_conjugate(q_hit), torch.linalg.cross(arm, kick) / inertia
        )

        since = _ramp(time - hit, get["contact_time"], get["smoothing"]) * self.hits
        since = since[..., None]
        near, fast, pull, slow = (y[..., None, :] for y in (x0, v0, gravity, drag))
        x, _ = _ballistic(near, fast, pull, slow, time[..., None])
        x = x + kick[..., None, :] * since
        # before and after the impact the body turns about fixed axes
        whole = _slowed(time, spin)[..., None] * rates[..., None, :]
        before = (_slowed(hit, spin) * rates)[..., None, :]
        rest = whole - before + twist[..., None, :] * since
        is_after = since > 0.0
        q = quaternion_product(
            q0[..., None, :], quaternion_from_rotation_vector(torch.where(is_after, before, whole))
        )
        q = quaternion_product(q, quaternion_from_rotation_vector(torch.where(is_after, rest, 0.0)))
        # at rest on a face, wherever that is: the slope of the board is left out
        rest = HALF_WIDTH * (1.0 + get["half_width"]) + get["ground_height"]
        x = x + rotate_by_quaternion(q, get["center"][..., None, :])
        scale = 1.0 + get["length_scale"][..., None]
        return torch.cat([scale * x, q, (scale * rest[..., None]).expand_as(q[..., :1])], -1)


@dataclass(frozen=True, eq=False)
class Table:
    """All tosses of a study and how their start states follow from the records.

    Attributes:
        tosses: All tosses, side by side.
        shooting: Fit of the start states of all tosses; None while it is prepared.
        place: Index of each run in ``tosses``, by name of the run.
        latest: The last prediction of all tosses by its arguments: they are flown at once, and
            asked for one by one.
    """

    tosses: Tosses
    shooting: Shooting
    place: Mapping[str, int]
    latest: dict[tuple[bytes, ...], Tensor] = field(default_factory=dict)

    def predict(
        self, name: str, values: Mapping[str, Tensor], terms: Mapping[str, Tensor]
    ) -> Tensor:
        """(K, length, 8) of one toss with the best start states."""
        index = self.place[name]
        given = [*values.values(), *terms.values()]
        if any(v.requires_grad for v in given):
            one = self.tosses.only(index)
            s = self.shooting
            cut = [getattr(s, f.name)[index : index + 1] for f in fields(s)]
            return _profiled(one, Shooting(*cut), values, terms)[:, 0]
        key = (*map(str.encode, terms), *(v.numpy().tobytes() for v in given))
        if key not in self.latest:
            self.latest.clear()
            self.latest[key] = _profiled(self.tosses, self.shooting, values, terms)
        return self.latest[key][:, index]


@dataclass(frozen=True, eq=False)
class TossScene:
    """One toss of the cube.

    Attributes:
        run: Recorded toss.
        values: restitution and friction, () or (K,).
        table: All tosses of the study with their start states.
        terms: Sizes of what effects add, (..., num_components); see ``TERMS``.
    """

    run: Run
    values: Mapping[str, Tensor]
    table: Table
    terms: Mapping[str, Tensor] = field(default_factory=dict)

    def with_term(self, name: str, size: Tensor) -> TossScene:
        """A copy in which a term has grown by ``size``, (..., num_components)."""
        so_far = self.terms.get(name)
        return replace(self, terms={**self.terms, name: size if so_far is None else so_far + size})

    def simulate(self) -> Tensor:
        """(..., num_samples, 8) position, quaternion, height at rest, with the best start state."""
        out = self.table.predict(self.run.name, self.values, self.terms)
        out = out[:, : len(self.run.time_s)]
        return out[0] if self.values["restitution"].ndim == 0 else out


class TossModel(SimModel):
    """The cube with friction and restitution; start states profiled at ``at``.

    Args:
        runs: Tosses of the study.
        channels: Channels of the study.
        at: Restitution and friction where start states are linearized; the prior if None.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        channels: Sequence[Channel],
        at: Mapping[str, Tensor] | None = None,
    ):
        base = (
            Parameter("restitution", 0.125, 0.5, "-", log=True, upper=1.0),
            Parameter("friction", 0.18, 0.5, "-", log=True),
        )
        self.runs, self.channels = tuple(runs), tuple(channels)
        start = at or {p.name: torch.tensor(p.value, dtype=torch.float64) for p in base}
        table = _prepared(self.runs, self.channels, start)

        def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> TossScene:
            return TossScene(run, values, table)

        super().__init__(build, base, "tossed cube", batched=True)

    def prepared_at(self, q: Tensor) -> SimModel:
        """Start states linearized at the values of these coordinates."""
        values = {p.name: p.value_at(q[i]) for i, p in enumerate(self.base)}
        return TossModel(self.runs, self.channels, values)


def _prepared(
    runs: Sequence[Run], channels: Sequence[Channel], values: Mapping[str, Tensor]
) -> Table:
    tosses = Tosses.of(runs)
    sd = torch.tensor([c.sd for c in channels], dtype=torch.float64)
    count = len(runs)

    def flown(start: Tensor) -> Tensor:
        return tosses.fly(start.reshape(-1, count, 12), values, {}).flatten(0, 1)

    start = tosses.start
    for _ in range(2):  # once more from better start states
        prepared = Shooting.prepare(flown, start, tosses.measured, sd)
        left = (tosses.measured - flown(start)).nan_to_num(0.0)
        start = start + (prepared.gain @ left.reshape(count, -1, 1))[..., 0]
    shooting = Shooting.prepare(flown, start, tosses.measured, sd)
    return Table(tosses, shooting, {r.name: i for i, r in enumerate(runs)})


def _profiled(
    tosses: Tosses, shooting: Shooting, values: Mapping[str, Tensor], terms: Mapping[str, Tensor]
) -> Tensor:
    """(K, num_tosses, length, 8) with the best start states."""
    many = values["restitution"].numel()
    return shooting.profile(lambda start: tosses.fly(start, values, terms), many)


def _sized(terms: Mapping[str, Tensor], name: str, k: int) -> Tensor:
    """(K, 1, num_components) of a term, zero where no effect has set it."""
    size = terms.get(name, torch.zeros(TERMS[name], dtype=torch.float64))
    return size.expand(k, TERMS[name])[:, None]


def _ballistic(
    x: Tensor, v: Tensor, gravity: Tensor, drag: Tensor, t: Tensor
) -> tuple[Tensor, Tensor]:
    """Place and velocity under gravity and v' = g - drag v, to first order in drag t."""
    place = x + v * (t - drag * t**2 / 2.0) + gravity * (t**2 / 2.0 - drag * t**3 / 6.0)
    return place, v * (1.0 - drag * t) + gravity * (t - drag * t**2 / 2.0)


def _slowed(t: Tensor, drag: Tensor) -> Tensor:
    """Integral of 1 - drag t."""
    return t - drag * t**2 / 2.0


def _ramp(since: Tensor, contact: Tensor, width: Tensor) -> Tensor:
    """Time since the impact that counts: integral of a step, of a ramp over ``contact`` after it,
    or of one over ``width`` about it (then the camera's smoothing, not the contact)."""
    length = (contact + width).clamp(min=SHORTEST)
    s = since + width / 2.0
    inside = s.clamp(min=0.0) ** 2 / (2.0 * length)
    return torch.where(s > length, s - length / 2.0, inside)
