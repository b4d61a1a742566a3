"""``model: {system: rigid_body}``: bodies that fly, bounce, slide and roll, and what sees them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from diffsim.causes.plant import IN_TIME, Plant
from diffsim.causes.scales import SCALES, Scales
from diffsim.core.check import did_you_mean
from diffsim.core.inside import inside
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.jacobian import Jacobian
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import (
    Description,
    Quantity,
    chosen_effects,
    settings_with,
)
from diffsim.systems.quantities import Acceleration
from diffsim.systems.rigid_body.ball_setup import Balls
from diffsim.systems.rigid_body.causes import measure_scales
from diffsim.systems.rigid_body.parts import (
    GROUND,
    Body,
    Camera,
    Contact,
    Ground,
    Measure,
    Starts,
    Window,
)
from diffsim.systems.rigid_body.tossing import TossedBody

#: Flight, impact and cameras each have causes of their own.
_TOSS = SearchSettings(
    max_effects=4,
    num_refits=2,
    max_rounds=8,
    rival_nats=5.0,
    unknown_steps=1,  # drifts of each run are many columns
)
_BALLS = SearchSettings(max_effects=6)
_STEP = 1e-4


class RigidBodyDescription(Description):
    """Rigid bodies: tossed boxes through their first impact; balls through all of theirs."""

    bodies: tuple[Body, ...] = Field(min_length=1, description="The bodies")
    gravity: Acceleration = Field(
        Quantity(value=9.81), description="Gravity, known to 0.3 % everywhere on earth"
    )
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field(
        "z", description="Axis of the recorded frame that points up"
    )
    ground: Ground | None = Field(Ground(), description="The plane below; null: none")
    contacts: tuple[Contact, ...] = Field((), description="Which bodies touch, and how")
    measures: tuple[Measure, ...] = Field(min_length=1, description="What the channels show")
    window: Window | None = Field(
        None, description="How much of a toss counts; default: all of it, in free flight"
    )
    starts: Starts = Field(Starts(), description="Which runs share a start of their balls")
    camera: Camera | None = Field(None, description="Camera of the channels in pixels")

    @model_validator(mode="after")
    def _check_names(self) -> RigidBodyDescription:
        known = [b.name for b in self.bodies]
        if len(set(known)) < len(known):
            raise ValueError(f"names of bodies repeat: {', '.join(known)}")
        for body in self.bodies:
            if body.like is not None:
                _require_known(f"bodies: like of {body.name}", body.like, known)
        for i, contact in enumerate(self.contacts):
            for name in contact.between:
                _require_known(f"contacts[{i}].between", name, [*known, GROUND])
        for i, measure in enumerate(self.measures):
            _require_known(f"measures[{i}].body", measure.body, known)
            if measure.pixels and self.camera is None:
                raise ValueError(f"measures[{i}] is in pixels; describe the ``camera``")
        return self

    def problems(self, study: Study) -> list[Problem]:
        """Channels that no measure shows, and facts that runs lack."""
        names = [c.name for c in study.channels]
        shown = [c for m in self.measures for _, _, c in m.rows()]
        out = [
            Problem("error", "model.measures", f"no channel {c}{did_you_mean(c, names)}")
            for c in shown
            if c not in names
        ]
        out += [
            Problem("error", f"channel {c}", "no entry of model.measures says what it shows")
            for c in names
            if c not in shown
        ]
        if all(b.is_ball for b in self.bodies):
            return out + self._find_problems_of_balls() + self._find_problems_of_camera(study)
        return out + self._find_problems_of_toss(study)

    def _find_problems_of_balls(self) -> list[Problem]:
        out = []
        pairs = [c for c in self.contacts if GROUND not in c.between]
        begins = {b.name: b.begins for b in self.bodies}
        if len(pairs) > 1 or any(begins[n] == "flying" for c in pairs for n in c.between):
            out.append(
                Problem("error", "model.contacts", "two balls may meet once, both on the ground")
            )
        for measure in self.measures:
            if measure.quaternion or measure.angles or measure.spin:
                out.append(
                    Problem(
                        "error",
                        "model.measures",
                        f"{measure.body} is a ball, whose turn is not followed; give its "
                        "position, velocity or pixels",
                    )
                )
        return out

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options; the study as its windows cut it."""
        if wrong := [p for p in self.problems(study) if p.severity == "error"]:
            raise ValueError("\n".join(f"{p.where}: {p.message}" for p in wrong))
        if all(b.is_ball for b in self.bodies):
            return self._make_setup_of_balls(study)
        return self.setup_of_cut(self._build_tossed().cut_study(study))

    def balls(self) -> Balls:
        """The balls with all that is around them."""
        return Balls(
            bodies=self.bodies,
            contacts=self.contacts,
            height=None if self.ground is None else self.ground.height,
            gravity=self.gravity,
            measures=self.measures,
            up=self.up,
            starts=self.starts,
            camera=self.camera,
        )

    def _make_setup_of_balls(self, study: Study) -> DiagnosisSetup:
        balls = self.balls()
        study = balls.with_clicks(study)
        scales = self.scales(study)
        model = balls.model(study)
        model.frame = {SCALES: scales.saved()}
        return DiagnosisSetup(
            model,
            chosen_effects(balls.causes(study, scales), self.effects, study, self.plant(study)),
            settings=settings_with(self._make_settings_of_balls(), self.effort),
            study=study,
        )

    def scales(self, study: Study) -> Scales:
        """Usual magnitudes of the recordings and of the air."""
        return measure_scales(study, self.bodies, self.gravity.value)

    def plant(self, study: Study) -> Plant:
        """What the bodies offer to causes of a user."""
        if all(b.is_ball for b in self.bodies):
            numbers = self.balls().numbers()
        else:
            numbers = self._build_tossed().numbers()
        return Plant(
            kind="rigid_body",
            scales=self.scales(study),
            channels=study.channels,
            numbers=numbers,
            facts={IN_TIME: True},
        )

    def _make_settings_of_balls(self) -> DiagnosisSettings:
        settings = DiagnosisSettings(search=_BALLS)
        if any(b.begins == "flying" for b in self.bodies):
            # a wide step would carry bounces past samples, where the motion has a kink
            settings = replace(settings, jacobian=Jacobian(step=_STEP))
        return settings

    def setup_of_cut(self, study: Study) -> DiagnosisSetup:
        """Setup of tosses that are cut already."""
        tossed = self._build_tossed()
        scales = self.scales(study)
        model = tossed.model(study)
        model.frame = {SCALES: scales.saved()}
        return DiagnosisSetup(
            model,
            chosen_effects(tossed.causes(study, scales), self.effects, study, self.plant(study)),
            settings=settings_with(DiagnosisSettings(search=_TOSS), self.effort),
            study=study,
        )

    def _build_tossed(self) -> TossedBody:
        body = self.bodies[0]
        ground = [c for c in self.contacts if GROUND in c.between]
        return TossedBody(
            body=body,
            ground=ground[0] if ground else None,
            height=0.0 if self.ground is None else self.ground.height,
            gravity=self.gravity,
            measures=self.measures,
            up=self.up,
            window=self.window,
        )

    def _find_problems_of_camera(self, study: Study) -> list[Problem]:
        camera = self.camera
        if camera is None or camera.points is None:
            return []
        try:
            path = inside(study.folder or Path(), camera.points.file, "file")
        except ValueError as error:
            return [Problem("error", "model.camera.points.file", str(error))]
        if path.is_file():
            return []
        what = "the camera keeps its first guess" if camera.is_stated else "nothing else finds it"
        severity = "warning" if camera.is_stated else "error"
        return [Problem(severity, "model.camera.points.file", f"no file {path}; {what}")]

    def _find_problems_of_toss(self, study: Study) -> list[Problem]:
        out = []
        if len(self.bodies) > 1:
            out.append(Problem("error", "model.bodies", "several bodies must all be balls"))
        if self.camera is not None:
            out.append(Problem("error", "model.camera", "a camera shows balls; give positions"))
        if any(q.per for q in self._build_tossed()._list_quantities().values()):
            out.append(Problem("error", "model", "per: tosses share all quantities; leave it out"))
        if not any(c.between for c in self.contacts if GROUND in c.between) and self.window:
            out.append(Problem("error", "model.window", "a window needs a contact with the ground"))
        turns = any(m.quaternion or m.angles for m in self.measures)
        if self.window is not None and not turns:
            out.append(
                Problem("error", "model.window", "finding the corner that hits needs the turn")
            )
        for channel in study.channels:
            if channel.sd is None:
                out.append(
                    Problem(
                        "error",
                        f"channel {channel.name}",
                        "start states are found by the noise of the channels; state its sd",
                    )
                )
        return out


def _require_known(where: str, name: str, known: list[str]) -> None:
    if name not in known:
        raise ValueError(f"{where}: no {name!r}{did_you_mean(name, known)}; known: {known}")


__all__ = ["RigidBodyDescription"]
