"""A described soft body as a diagnosis found it: sizes of an ``extended_model.yaml`` in a task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from diffsim.data.study import Channel, Run, Study
from diffsim.identify.extended import ExtendedModel
from diffsim.identify.model_file import SavedModel, read_extended, rebuilt
from diffsim.identify.numerics import Numerics
from diffsim.systems.registry import setup_of
from diffsim.systems.soft_body.body_keys import SoftBodyKeys
from diffsim.systems.soft_body.robot import DescribedRobot
from diffsim.systems.soft_body.scene import SoftScene

SYSTEM = "described soft body"  # name of the plain model in the file
_UNITS = {"axis": ("m", "position"), "about": ("rad", "angle")}


@dataclass(frozen=True, eq=False)
class FoundRobot:
    """A soft body with the causes that a diagnosis named."""

    saved: SavedModel
    model: ExtendedModel  # plain model with its causes, at the file's values
    plain: DescribedRobot  # the body without them
    run: Run  # stands for a run of a study: facts of its set-up

    @classmethod
    def read(
        cls,
        path: str | Path | SavedModel,
        keys: Mapping[str, Any],
        plain: DescribedRobot,
        folder: Path | None,
        setup: Mapping[str, Any],
    ) -> FoundRobot:
        """Read an ``extended_model.yaml``.

        Args:
            path: The file, or the folder that holds it, or its content.
            keys: The task's ``model``, which the study had, channels included.
            folder: Folder that its files are relative to.
            setup: Facts of the set-up.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a file of another system or model, or causes that a task cannot simulate.
        """
        saved = path if isinstance(path, SavedModel) else read_extended(path)
        if saved.model != SYSTEM:
            raise ValueError(
                f"{saved.path}: a model of {saved.model or 'an unnamed system'}, not of a soft "
                "body that a study describes"
            )
        given = SoftBodyKeys.model_validate(keys)
        times = np.array([0.0, given.numerics.time_step])
        channels = tuple(
            Channel(name, *_UNITS["axis" if reading.about is None else "about"])
            for name, reading in given.channels.items()
        )
        still = {name: np.zeros(2) for name in given.commands}
        measured = np.full((2, len(channels)), np.nan)
        run = Run("task", times, measured, still, "task", setup=dict(setup))
        study = Study(
            name=saved.study,
            system="soft_body",
            channels=channels,
            runs=(run,),
            model=dict(keys),
            folder=folder,
        )
        made = cls(saved, rebuilt(saved, setup_of(saved.framed(study))), plain, run)
        made._require_possible()
        return made

    def _require_possible(self) -> None:
        """Refuse causes that need time or the past of an episode."""
        scene = self.scene(self.model.at_prior())
        forces = [make() for make in scene.makers]
        wrong = [type(f).__name__.strip("_") for f in forces if not f.of_state]
        if scene.commands.changes:
            wrong.append("a map of commands")
        if type(scene) is not SoftScene:
            wrong.append(type(scene).__name__)
        if wrong:
            raise ValueError(
                f"{self.saved.path}: {', '.join(wrong)} of {', '.join(self.causes)} needs time or "
                "the past, which a soft body's task does not keep; diagnose without it (diffsim "
                "diagnose explain STUDY --without CAUSE)"
            )

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the causes that are built in."""
        return tuple(e.name for e in self.model.effects)

    def scene(self, q: Tensor) -> SoftScene:
        """The body at standardized sizes, (num_base,)."""
        scene = self.model.build(self.model.values.at(q), self.run, Numerics())
        assert isinstance(scene, SoftScene)
        return scene

    def draw(self, batch: int, rng: np.random.Generator) -> Tensor:
        """Standardized sizes that the data allow, (batch, num_base)."""
        return self.saved.draw_coordinates(self.model.base, batch, rng)

    def robot(self) -> DescribedRobot:
        """The body at the file's values."""
        return replace(self.plain, scene=self.scene(self.model.at_prior()))

    def robots(self, sizes: Tensor) -> DescribedRobot:
        """The bodies of a batch at standardized sizes, (batch, num_base)."""
        return replace(self.robot(), members=tuple(self.scene(q) for q in sizes))
