"""``model: {system: rigid_body}``: bodies that fly, bounce, slide and roll, and what sees them."""

from __future__ import annotations

from collections.abc import Iterator

from diffsim.causes.plant import IN_TIME, Plant
from diffsim.causes.scales import Scales
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.systems.description import mismatched_channels
from diffsim.systems.rigid_body.ball_setup import Balls
from diffsim.systems.rigid_body.parts import RigidBodyKeys
from diffsim.systems.rigid_body.tossing import TossedBody

AIR = "air"  # what plain magnitudes are of
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
