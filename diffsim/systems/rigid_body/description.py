"""``model: {system: rigid_body}``: bodies that fly, bounce, slide and roll, and what sees them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from diffsim.causes.plant import IN_TIME, Plant
from diffsim.causes.scales import Scales
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.model import SimModel
from diffsim.systems.description import BaseParameters, Quantity, mismatched_channels
from diffsim.systems.rigid_body.ball_setup import Balls
from diffsim.systems.rigid_body.layout import REST, PoseLayout
from diffsim.systems.rigid_body.model import TossModel, TossSetup
from diffsim.systems.rigid_body.parts import ANGLES, GROUND, Contact, RigidBodyKeys
from diffsim.systems.rigid_body.toss import TOSS, Mass, added
from diffsim.systems.rigid_body.windows import (
    MIN_FRAMES,
    RecordedPoses,
    angles_to_quaternions,
    continuous,
    cut,
    face_below,
    filled,
    first_touch,
    rest_height,
    start_facts,
)

AIR = "air"  # what plain magnitudes are of
REST_EDGE_SHARE = 0.03  # of the shortest edge


class TossedBody:
    """A tossed body as a description states it.

    Attributes:
        contact: That with the ground; None: it is never touched.
    """

    kind = TOSS
    unwatched = (REST,)

    def __init__(self, given: RigidBodyKeys):
        self.given, self.body = given, given.bodies[0]
        self.contact = next((c for c in given.contacts if GROUND in c.between), None)

    def used_of(self, study: Study) -> Study:
        """Each toss until its window ends; too short ones are left out."""
        names = [c.name for c in study.channels]
        runs, rests, left_out = [], [], []
        for run in study.runs:
            run = self._with_continuous(run, names)
            poses = self._read_poses(run, names)
            short = self._cut_window(run, poses)
            if short is None:
                left_out.append(
                    f"run {run.name}: its window has fewer than {MIN_FRAMES} frames of flight"
                )
                continue
            rest = np.full((len(short.time_s), 1), np.nan)
            if self._rest_frames:
                assert self.given.window is not None
                rest[-1] = rest_height(poses, self.given.window.rest_frames) - self.given.height
                rests.append(rest[-1, 0])
                short = replace(short, measured=np.hstack([short.measured, rest]))
            runs.append(short)
        if not runs:
            raise ValueError(
                f"study {study.name}: no run has {MIN_FRAMES} frames of flight before its first "
                "contact; check the ground's height, the body's edges and the axis ``up``"
            )
        channels = list(study.channels)
        if self._rest_frames:
            assert self.given.window is not None
            sd = self.given.window.rest_sd or self._estimate_rest_scatter(rests)
            shown = next((c.shown_unit for c in channels if c.unit == "m"), None)
            channels.append(Channel(REST, "m", "position", sd, shown_unit=shown))
        told = (*study.left_out, *left_out)
        return replace(study, channels=tuple(channels), runs=tuple(runs), left_out=told)

    def _estimate_rest_scatter(self, rests: Sequence[float]) -> float:
        """Scatter of the height at rest; of under five, a hundredth of the shortest edge [m]."""
        few = len(rests) < 5
        edge = min((q.value for q in self.body.edges), default=1.0)
        return 0.01 * edge if few else max(float(np.std(rests)), 1e-6)

    def model(self, study: Study) -> TossModel:
        """Model of a cut study."""
        turn = self.given.turn.as_quat()[[3, 0, 1, 2]]
        rows = {c: (k, i) for m in self.given.measures for k, i, c in m.rows()} | {
            REST: ("rest", 0)
        }
        layout = PoseLayout([rows[c.name] for c in study.channels], torch.from_numpy(turn))
        parameters = BaseParameters(self._list_quantities(), study.runs)
        return TossModel(
            study.runs, study.channels, TossSetup(parameters, self._make_mass(), layout)
        )

    def facts(self) -> dict[str, bool]:
        """What holds of the body, as rows of causes ask for it."""
        is_seen = self._goes_through_rebound or bool(self._rest_frames)
        return {
            **dict.fromkeys(("tracked", "flies", "bounces", "strikes"), True),
            "gravity_is_fitted": self.given.gravity.is_fitted,
            "edges_are_known": bool(self.body.edges)
            and not any(q.is_fitted for q in self.body.edges),
            "meets_ground": self.contact is not None and is_seen,
        }

    def numbers(self) -> tuple[str, ...]:
        """Names of all numbers that causes may change."""
        return (*self._list_quantities(), *added())

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """What the description and a study disagree on."""
        if any(q.per for q in self._list_quantities().values()):
            yield Problem("error", "model", "per: tosses share all quantities; leave it out")
        if self.contact is None and self.given.window:
            yield Problem("error", "model.window", "a window needs a contact with the ground")
        turns = any(m.quaternion or m.angles for m in self.given.measures)
        if self.given.window is not None and not turns:
            said = "finding the corner that hits needs the turn"
            yield Problem("error", "model.window", said)
        for channel in study.channels:
            if channel.sd is None:
                said = "start states are found by the noise of the channels; state its sd"
                yield Problem("error", f"channel {channel.name}", said)

    def advise(self) -> DiagnosisSettings:
        """Effort that suits a toss: drifts of each run are many columns."""
        search = SearchSettings(
            max_effects=4, num_refits=2, max_rounds=8, rival_nats=5.0, unknown_steps=1
        )
        return DiagnosisSettings(search=search)

    @property
    def _goes_through_rebound(self) -> bool:
        return self.given.window is not None and self.given.window.until == "rebound"

    @property
    def _rest_frames(self) -> int:
        return 0 if self.given.window is None else self.given.window.rest_frames

    def _list_quantities(self) -> dict[str, Quantity]:
        """All numbers of the model; those that no run can show are known."""
        edges = self.body.edges or (Quantity(value=1.0),) * 3
        same = self.body.box is not None and len(self.body.box) == 1
        out = {"gravity": self.given.gravity, "ground": Quantity(value=self.given.height)}
        if same:
            out["edge"] = edges[0]
        else:
            out |= {f"edge_{a}": q for a, q in zip("xyz", edges, strict=True)}
        contact = self.contact or Contact(between=(self.body.name, "ground"))
        friction = contact.friction or Quantity(value=0.0)
        pair = {"restitution": contact.restitution, "friction": friction}
        if not self._goes_through_rebound:
            pair = {n: Quantity(value=q.value) for n, q in pair.items()}
        return {**pair, **out}

    def _make_mass(self) -> Mass:
        body = self.body
        if body.inertia is not None:
            assert body.mass is not None
            a, b, c = (i / body.mass for i in body.inertia)
            even = max(a, b, c) - min(a, b, c) < 1e-9 * max(a, b, c)
            return Mass((a, b, c), even, body.box is not None)
        edges = [q.value for q in body.edges]
        free = any(q.is_fitted for q in body.edges) and len(body.box or ()) == 3
        return Mass(None, max(edges) - min(edges) < 1e-12 and not free, True)

    def _with_continuous(self, run: Run, names: Sequence[str]) -> Run:
        """Quaternions without jumps of sign, angles without jumps of a turn."""
        measured = run.measured.copy()
        for measure in self.given.measures:
            if measure.quaternion:
                at = [names.index(c) for c in measure.quaternion]
                measured[:, at] = continuous(measured[:, at])
        return replace(run, measured=measured)

    def _read_poses(self, run: Run, names: Sequence[str]) -> RecordedPoses:
        turn = None
        for measure in self.given.measures:
            if measure.quaternion:
                turn = run.measured[:, [names.index(c) for c in measure.quaternion]]
            if measure.angles:
                columns = [run.measured[:, names.index(measure.angles[a])] for a in ANGLES]
                turn = angles_to_quaternions(columns)
        if turn is not None:
            seen = np.isfinite(turn).all(axis=1)
            turned = np.full_like(turn, np.nan)
            whole = self.given.turn * Rotation.from_quat(turn[seen][:, [1, 2, 3, 0]])
            turned[seen] = whole.as_quat()[:, [3, 0, 1, 2]]
            turn = continuous(turned)
        place = self.given.upright(self.given.places(run, names, self.body.name))
        return RecordedPoses(place, turn)

    def _cut_window(self, run: Run, poses: RecordedPoses) -> Run | None:
        """The run as far as it counts; None if too little of it does."""
        facts = start_facts(run, poses, self.given.gravity.value)
        end, corner, touch, hits = len(run.time_s), 0, len(run.time_s) - 1, False
        window = self.given.window
        complete = poses.turn is not None and np.isfinite(poses.place).any(axis=0).all()
        if window is not None and self.body.box is not None and complete:
            half = np.array([0.5 * q.value for q in self.body.edges])
            near = window.near or REST_EDGE_SHARE * 2.0 * float(half.min())
            found = first_touch(filled(poses), half, near, self.given.height)
            if found is not None:
                corner, touch = found.corner, found.touch
                hits = window.until == "rebound" and found.end > touch
                end = found.end if hits else touch - window.spared
        if end < MIN_FRAMES:
            return None
        more = {
            "_corner": float(corner),
            "_touch_s": float(run.time_s[touch]),
            "_hits": float(hits),
        }
        more["_face"] = float(face_below(poses))
        return cut(run, end, {**facts, **more})


LIFT, DRAG = 0.05, 0.02  # m/s^2 and 1/m: air around a body whose mass or shape is not stated


class RigidBodyDescription(RigidBodyKeys):
    """Rigid bodies: tossed boxes through their first impact; balls through all of theirs."""

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Channels that no measure shows, and facts that runs lack."""
        shown = [("model.measures", c) for m in self.measures for _, _, c in m.rows()]
        hint = "no entry of model.measures says what it shows"
        yield from mismatched_channels(shown, study, hint)
        if not all(b.is_ball for b in self.bodies):
            if len(self.bodies) > 1:
                yield Problem("error", "model.bodies", "several bodies must all be balls")
            if self.camera is not None:
                yield Problem("error", "model.camera", "a camera shows balls; give positions")
        yield from self.described.find_problems(study)

    @property
    def described(self) -> Balls | TossedBody:
        """The balls, or the tossed body, with all that is around them."""
        return Balls(self) if all(b.is_ball for b in self.bodies) else TossedBody(self)

    def used_of(self, study: Study) -> Study:
        """Tosses until their windows end; with clicked points as a run of their own."""
        return self.described.used_of(study)

    def advise(self) -> DiagnosisSettings:
        """Effort that suits what is described."""
        return self.described.advise()

    def model(self, study: Study) -> SimModel:
        """Model of the bodies."""
        return self.described.model(study)

    def plant(self, study: Study) -> Plant:
        """What the bodies tell of themselves.

        Instruments are judged where a study says which sensors there are. The scale of all that is
        seen is that of length.
        """
        of, scales = self.described, Scales.of(study, {AIR: self._measure_air()})
        seen = [c for c in study.channels if c.name not in of.unwatched]
        return Plant(
            kind=of.kind,
            scales=scales,
            channels=study.channels,
            numbers=of.numbers(),
            facts={
                IN_TIME: True,
                "free_starts": True,
                "one_instrument": len({c.sensor or c.kind for c in seen}) == 1,
                **of.facts(),
            },
            magnitudes=scales.plain[AIR],
            instruments=() if all(c.sensor is None for c in seen) else None,
            unwatched=of.unwatched,
        )

    def _measure_air(self) -> dict[str, float]:
        """Usual magnitudes of the air around the first body that states its mass and shape."""
        in_air = next((a for b in self.bodies if (a := b.in_air()) is not None), None)
        if in_air is None:
            return {"lift": LIFT, "drag": DRAG}
        return {"lift": in_air[0] * self.gravity.value, "drag": in_air[1]}
