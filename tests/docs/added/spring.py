"""A spring under a weight: a kind of system, as docs/adding.md says to write one."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from diffsim.causes.commands import CommandGroup
from diffsim.causes.plant import Plant
from diffsim.causes.scales import Scales
from diffsim.causes.scene import Commands, Scene, grid_of
from diffsim.data.study import Run, Study
from diffsim.identify.model import SimModel
from diffsim.systems.description import BaseParameters, Description, quantity


class SpringScene(Scene):
    """A spring in equilibrium at every sample."""

    def simulate(self) -> Tensor:
        """Extension, (num_samples, 1), with K in front for K points."""
        force = self.commands.heard(self.grid).mT
        stiffness, rest, harder = (
            self.number(name)[..., None, None] for name in ("stiffness", "rest", "harder")
        )
        shown = force / (stiffness * (1.0 + harder * force**2)) + rest
        return self.instruments.read_late(shown, self.grid)


def harden(scene: SpringScene, size: Tensor, run: Run) -> SpringScene:
    """The function of the row ``hardening``, which is ``at: scene``."""
    return scene.with_number("harder", lambda value: value + size[..., 0])


class SpringDescription(Description):
    """``model:`` of a spring."""

    system: Literal["spring"] = Field("spring", description="Kind of system: `spring`")
    force: str = Field(description="Command that pulls")
    stiffness: quantity("N/m") = Field(description="Force over extension")

    def plant(self, study: Study) -> Plant:
        """What the spring tells of itself; its causes follow from it and the table."""
        scales = Scales.of(study, {})
        usual = scales.of_commands((self.force,))
        return Plant(
            kind="spring",
            scales=scales,
            channels=study.channels,
            commands={self.force: "held"},
            ways=(CommandGroup((self.force,), usual, between="held"),),
            numbers=("stiffness", "rest"),
            fitted=("stiffness",) if self.stiffness.is_fitted else (),
            functions={"hardening": harden},
            magnitudes=usual,
        )

    def model(self, study: Study) -> SimModel:
        """Hooke's law, for all runs."""
        parameters = BaseParameters({"stiffness": self.stiffness}, study.runs)

        def build(values: Mapping[str, Tensor], run: Run, numerics: Any) -> SpringScene:
            force = torch.from_numpy(np.asarray(run.command[self.force], dtype=float))
            return SpringScene(
                grid=grid_of(run),
                numbers=parameters.in_run(values, run),
                zeros=("rest", "harder"),
                commands=Commands.named((self.force,), force[None]),
            )

        return SimModel(build, parameters.base, "spring", batched=True)
