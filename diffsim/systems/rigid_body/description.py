"""``model: {system: rigid_body}``: bodies that fly, bounce, slide and roll, and what sees them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from diffsim.causes.plant import IN_TIME, Plant
from diffsim.causes.scales import Scales
from diffsim.core.check import did_you_mean
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.systems.description import Description, Quantity, mismatched_channels
from diffsim.systems.quantities import Acceleration
from diffsim.systems.rigid_body.ball_setup import Balls
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

AIR = "air"  # what plain magnitudes are of
LIFT, DRAG = 0.05, 0.02  # m/s^2 and 1/m: air around a body whose mass or shape is not stated


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
        shown = [("model.measures", c) for m in self.measures for _, _, c in m.rows()]
        hint = "no entry of model.measures says what it shows"
        out = list(mismatched_channels(shown, study, hint))
        if not all(b.is_ball for b in self.bodies):
            if len(self.bodies) > 1:
                out.append(Problem("error", "model.bodies", "several bodies must all be balls"))
            if self.camera is not None:
                said = "a camera shows balls; give positions"
                out.append(Problem("error", "model.camera", said))
        return [*out, *self.described.find_problems(study)]

    @property
    def described(self) -> Balls | TossedBody:
        """The balls, or the tossed body, with all that is around them."""
        if all(b.is_ball for b in self.bodies):
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
        return TossedBody(
            body=self.bodies[0],
            ground=next((c for c in self.contacts if GROUND in c.between), None),
            height=0.0 if self.ground is None else self.ground.height,
            gravity=self.gravity,
            measures=self.measures,
            up=self.up,
            window=self.window,
        )

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


def _require_known(where: str, name: str, known: list[str]) -> None:
    if name not in known:
        raise ValueError(f"{where}: no {name!r}{did_you_mean(name, known)}; known: {known}")
