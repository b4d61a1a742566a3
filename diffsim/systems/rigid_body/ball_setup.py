"""From a description and its recordings to the model of balls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.listing import numbers_added
from diffsim.causes.scene import grid_at
from diffsim.core.arrays import Array
from diffsim.core.inside import inside
from diffsim.data.calibration import calibrate
from diffsim.data.study import TIMELESS, Channel, Run, Study
from diffsim.data.study_check import Problem
from diffsim.data.table import read_numbers
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.jacobian import Jacobian
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.shape import MovingShape
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.rigid_body.ball_scene import (
    BallBody,
    BallScene,
    BallStage,
    Pair,
    PinholeCamera,
)
from diffsim.systems.rigid_body.ball_starts import SPIN_SD, BallStarts
from diffsim.systems.rigid_body.camera import in_free_flight, on_plane, plain_camera
from diffsim.systems.rigid_body.figure import balls_measured, balls_simulated
from diffsim.systems.rigid_body.parts import GROUND, Body, Camera, Contact, RigidBodyKeys
from diffsim.systems.rigid_body.parts import Points as PointKeys

CLICKS = "calibration_points"
CLICK_CHANNELS = ("clicked_u_px", "clicked_v_px")
BALLS = "balls"  # the kind of system, and its table
FIRST_FLIGHT = 0.3  # s: long enough to show how a ball falls, short of most bounces


@dataclass(frozen=True, eq=False)
class Points:
    """Clicked points: pixels (n, 2) [px] and their places (n, 3) [m]."""

    pixels: Array
    places: Array


class Balls:
    """Balls as a description states them."""

    kind = BALLS
    unwatched = CLICK_CHANNELS

    def __init__(self, given: RigidBodyKeys):
        self.given = given

    def used_of(self, study: Study) -> Study:
        """The study with the camera's points as a run and two channels of their own."""
        points = self._load_points(study)
        if points is None or self.given.camera is None or self.given.camera.points is None:
            return study
        sd = self.given.camera.points.sd
        width = len(study.channels)
        runs = [
            replace(r, measured=np.pad(r.measured, ((0, 0), (0, 2)), constant_values=np.nan))
            for r in study.runs
        ]
        measured = np.full((len(points.pixels), width + 2), np.nan)
        measured[:, width:] = points.pixels
        order = min(r.order for r in runs) - 1
        no_command = {n: np.zeros(len(measured)) for n in runs[0].command}
        time_s, facts = np.arange(float(len(measured))), {TIMELESS: True}
        unknown = {n: np.full(len(measured), np.nan) for n in runs[0].columns}
        clicks = Run(CLICKS, time_s, measured, no_command, CLICKS, order, "fit", facts, unknown)
        channels = [*study.channels, *(Channel(c, "px", "image", sd) for c in CLICK_CHANNELS)]
        return replace(study, channels=tuple(channels), runs=(clicks, *runs))

    def model(self, study: Study, clicks: Mapping[str, Array] | None = None) -> SimModel:
        """Model of a study with clicks.

        Args:
            study: Runs, that of the clicks among them.
            clicks: Places of clicked points that runs hold beside their balls, one per sample,
                (num_samples, 3) [m] by name of the run.
        """
        points = self._load_points(study)
        runs = [r for r in study.runs if r.name != CLICKS]
        eye, camera = self._find_eye(points)
        stage = self._build_stage([c.name for c in study.channels], eye)
        quantities = BaseParameters({**self._list_quantities(), **camera}, runs)
        starts = BallStarts(
            self.given.bodies,
            self.given.starts,
            runs,
            lambda run, body: self._find_places(run, body, study, eye, camera),
            self.given.gravity.value,
            frozenset(m.body for m in self.given.measures if m.pixels),
        )
        zero = torch.zeros((), dtype=torch.float64)
        plain = dict.fromkeys(numbers_added(BALLS, {}), zero) | (
            {} if eye is None else dict(eye.plain)
        )
        stages = {run.name: stage for run in runs}
        if eye is not None:
            for name, places in (clicks or {}).items():
                corners = torch.from_numpy(np.ascontiguousarray(places))
                stages[name] = replace(stage, eye=replace(eye, corners=corners))
            if points is not None:
                corners = torch.from_numpy(np.ascontiguousarray(points.places))
                only = replace(stage, bodies=(), pair=None)
                stages[CLICKS] = replace(only, eye=replace(eye, corners=corners))

        clocks = {run.name: run.time_s for run in study.runs}

        def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> BallScene:
            is_clicks = run.name == CLICKS
            known = quantities.in_run(values, runs[0] if is_clicks else run)
            start = {} if is_clicks else starts.in_run(values, run)
            since = 0.0 if is_clicks else starts.at(run)
            time = torch.from_numpy(np.asarray(run.time_s, dtype=np.float64) - since)
            # a run that nobody has recorded yet is seen as all others are
            shown = _shorten_stage(
                stages.get(run.name, stage), clocks.get(run.name, run.time_s), run
            )
            return BallScene(grid=grid_at(time), numbers={**plain, **known, **start}, stage=shown)

        base = (*quantities.base, *starts.base)
        return BallModel(build, base, "balls", batched=True)

    def numbers(self) -> tuple[str, ...]:
        """Names of all numbers that causes may change."""
        camera = () if self.given.camera is None else ("focal", *(f"shift_{a}" for a in "xyz"))
        return (*self._list_quantities(), *numbers_added(BALLS, {}), *camera)

    def facts(self) -> dict[str, bool]:
        """What holds of the balls, as rows of causes ask for it."""
        seen = {kind for m in self.given.measures for kind, _, _ in m.rows()}
        flies = any(b.begins == "flying" for b in self.given.bodies)
        bounces = flies and any(GROUND in c.between for c in self.given.contacts)
        stated = [GROUND in c.between for c in self.given.contacts if c.friction is not None]
        return {
            "flies": flies,
            "bounces": bounces,
            "meets_ground": bounces,
            "on_ground": bounces or any(b.begins != "flying" for b in self.given.bodies),
            "strikes": self._pair_contact is not None,
            "filmed": "pixels" in seen,
            "tracked": bool(seen & {"position", "velocity"}),
            "gravity_is_fitted": self.given.gravity.is_fitted,
            "ground_friction": True in stated,
            "pair_friction": False in stated,
        }

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """What the description and a study disagree on."""
        pairs = [c for c in self.given.contacts if GROUND not in c.between]
        begins = {b.name: b.begins for b in self.given.bodies}
        if len(pairs) > 1 or any(begins[n] == "flying" for c in pairs for n in c.between):
            said = "two balls may meet once, both on the ground"
            yield Problem("error", "model.contacts", said)
        for measure in self.given.measures:
            if measure.quaternion or measure.angles or measure.spin:
                said = (
                    f"{measure.body} is a ball, whose turn is not followed; give its position, "
                    "velocity or pixels"
                )
                yield Problem("error", "model.measures", said)
        if self.given.camera is not None and self.given.camera.points is not None:
            yield from _find_problems_of_points(self.given.camera, self.given.camera.points, study)

    def advise(self) -> DiagnosisSettings:
        """Effort that suits balls."""
        settings = DiagnosisSettings(search=SearchSettings(max_effects=6))
        flies = any(b.begins == "flying" for b in self.given.bodies)
        # a wider step would carry bounces past samples, where the motion has a kink
        return replace(settings, jacobian=Jacobian(step=1e-4)) if flies else settings

    @property
    def _pair_contact(self) -> Contact | None:
        return next((c for c in self.given.contacts if GROUND not in c.between), None)

    def _find_shape_owner(self, body: Body) -> Body:
        """The body whose diameter and inertia this one has."""
        if body.like is None:
            return body
        return next(b for b in self.given.bodies if b.name == body.like)

    def _name_key(self, contact: Contact, what: str) -> str:
        """Name of a contact's quantity: plain if there is only one contact."""
        if len(self.given.contacts) == 1:
            return what
        names = [n for n in contact.between if n != GROUND]
        return f"{what}_{'_'.join(names)}" + ("_ground" if GROUND in contact.between else "")

    def _name_diameter(self, body: Body) -> str:
        shapes = {self._find_shape_owner(b).name for b in self.given.bodies}
        return "diameter" if len(shapes) == 1 else f"{self._find_shape_owner(body).name}_diameter"

    def _list_quantities(self) -> dict[str, Quantity]:
        out = {"gravity": self.given.gravity, "ground": Quantity(value=self.given.height)}
        for body in self.given.bodies:
            if body.sphere is not None:
                out[self._name_diameter(body)] = body.sphere
        for contact in self.given.contacts:
            out[self._name_key(contact, "restitution")] = contact.restitution
            friction = contact.friction or Quantity(value=0.0)
            out[self._name_key(contact, "friction")] = friction
        if self._pair_contact is not None:
            out["sidespin"] = Quantity(value=0.0, sd=SPIN_SD, unit="m/s")
        return out

    def _build_stage(self, channels: Sequence[str], eye: PinholeCamera | None) -> BallStage:
        index = {b.name: i for i, b in enumerate(self.given.bodies)}
        rows = {c: (k, index[m.body], i) for m in self.given.measures for k, i, c in m.rows()}
        for names in (CLICK_CHANNELS, ("corner_u_px", "corner_v_px")):
            rows |= {c: ("click", 0, i) for i, c in enumerate(names)}
        frame = self.given.turn.as_matrix().T
        bodies = []
        for body in self.given.bodies:
            touch = next(
                (c for c in self.given.contacts if GROUND in c.between and body.name in c.between),
                None,
            )
            shape = self._find_shape_owner(body)
            bodies.append(
                BallBody(
                    body.name,
                    body.begins,
                    self._name_diameter(body),
                    None if touch is None else self._name_key(touch, "restitution"),
                    None if touch is None else self._name_key(touch, "friction"),
                    shape.inertia_ratio or 0.4,  # of a solid ball
                )
            )
        return BallStage(
            bodies,
            self._build_pair(index),
            [rows[c] for c in channels],
            torch.from_numpy(np.ascontiguousarray(frame)),
            eye,
        )

    def _build_pair(self, index: Mapping[str, int]) -> Pair | None:
        contact = self._pair_contact
        if contact is None:
            return None
        i, j = (index[n] for n in contact.between)
        if self.given.bodies[i].begins != "at_rest":  # the one that rests is struck
            i, j = (j, i) if self.given.bodies[j].begins == "at_rest" else (i, j)
        masses = [self._find_shape_owner(self.given.bodies[b]).mass or 1.0 for b in (i, j)]
        own = [self.given.bodies[b].mass or m for b, m in zip((i, j), masses, strict=True)]
        keys = [self._name_key(contact, what) for what in ("restitution", "friction")]
        return Pair((i, j), keys[0], keys[1], own[0] / own[1])

    def _load_points(self, study: Study) -> Points | None:
        if self.given.camera is None or self.given.camera.points is None:
            return None
        given = self.given.camera.points
        path = inside(study.folder or Path(), given.file, "model.camera.points.file")
        if self.given.camera.is_stated and not path.is_file():
            return None  # as where a saved model is judged, which knows its camera
        data = read_numbers(path, list(given.columns))
        table = np.column_stack([data[c] for c in given.columns])
        return Points(table[:, :2], table[:, 2:])

    def _find_eye(self, points: Points | None) -> tuple[PinholeCamera | None, dict[str, Quantity]]:
        """The camera before its fit, and what is fitted of it."""
        camera = self.given.camera
        if camera is None:
            return None, {}
        focal, rotation, shift = camera.focal, camera.rotation, camera.shift
        if focal is None or rotation is None or shift is None:
            assert points is not None
            found = calibrate(
                points.places, points.pixels, (int(camera.size[0]), int(camera.size[1]))
            )
            focal = focal or Quantity(value=found["alpha_px"], percent=15.0, unit="px")
            rotation = rotation or found["R"]
            shift = shift or tuple(Quantity(value=float(t), sd=0.1, unit="m") for t in found["T_m"])
        eye = PinholeCamera(
            torch.tensor(rotation, dtype=torch.float64), camera.size[1], plain_camera(camera.size)
        )
        turn = Quantity(value=0.0, sd=camera.turn_sd, unit="rad")
        named = {"focal": focal} | {f"turn_{a}": turn for a in "xyz"}
        return eye, named | {f"shift_{a}": q for a, q in zip("xyz", shift, strict=True)}

    def _find_places(
        self,
        run: Run,
        body: Body,
        study: Study,
        eye: PinholeCamera | None,
        camera: Mapping[str, Quantity],
    ) -> Array:
        """Places of a ball as a run shows them, (num_samples, 3) [m] with z up; NaN if unseen."""
        names = [c.name for c in study.channels]
        for measure in (m for m in self.given.measures if m.body == body.name):
            if measure.pixels and eye is not None:
                pixels = run.measured[:, [names.index(c) for c in measure.pixels]]
                values = {n: torch.tensor(q.value).double() for n, q in camera.items()}
                values = {**eye.plain, **values}
                if body.begins == "flying":
                    first = run.time_s - run.time_s[0] < FIRST_FLIGHT
                    pixels = np.where(first[:, None], pixels, np.nan)
                    seen, time = torch.from_numpy(pixels), torch.from_numpy(run.time_s)
                    return in_free_flight(
                        values, eye.rotation, seen, time, self.given.gravity.value
                    ).numpy()
                diameter = self._find_shape_owner(body).sphere
                assert diameter is not None
                level = 0.5 * diameter.value + (self.given.height)
                flat = on_plane(values, eye.rotation, torch.from_numpy(pixels), level)
                return np.column_stack([flat.numpy(), np.full(len(flat), level)])
        return self.given.upright(self.given.places(run, names, body.name))


def _find_problems_of_points(camera: Camera, given: PointKeys, study: Study) -> Iterator[Problem]:
    where = "model.camera.points.file"
    try:
        path = inside(study.folder or Path(), given.file, "file")
    except ValueError as error:
        yield Problem("error", where, str(error))
        return
    if not path.is_file():
        what = "the camera keeps its first guess" if camera.is_stated else "nothing else finds it"
        severity = "warning" if camera.is_stated else "error"
        yield Problem(severity, where, f"no file {path}; {what}")


class BallModel(SimModel):
    """Balls as a model, which shows them in space; arguments as for ``SimModel``."""

    # impacts are found one after the other: a flight with five takes 11 ms of one busy core, a
    # strike 5 ms, and slopes a fifth for each number
    run_cost, step_cost = 1500.0, 10.0
    _shape_of_scene = staticmethod(balls_simulated)

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """The balls where channels tell their positions."""
        scene = self.scene(run, self.at_prior())
        assert isinstance(scene, BallScene)
        return balls_measured(scene, channels)


def _shorten_stage(stage: BallStage, clock: Array, run: Run) -> BallStage:
    """The stage of a run of which a part may be left out: as many clicked points as samples."""
    eye = stage.eye
    if eye is None or eye.corners is None or len(eye.corners) == len(run.time_s):
        return stage
    rows = torch.from_numpy(np.searchsorted(clock, run.time_s))
    return replace(stage, eye=replace(eye, corners=eye.corners[rows]))
