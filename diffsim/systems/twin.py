"""A recorded system as a diagnosis found it: commands in, channels out, with gradients.

>>> twin = Twin.read("runs/cart", "cart/study.yaml", time_s)
>>> channels = twin.simulate({"force_N": force})  # (num_samples, num_channels), torch
>>> many = twin.simulate({"force_N": force}, at=twin.draw(16, rng))  # from the posterior
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import as_spelled, require, require_choice
from diffsim.core.checked import checked
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.identify.extended import ExtendedModel
from diffsim.identify.model_file import SavedModel, read_extended, rebuilt, without_effects
from diffsim.systems.description import Description
from diffsim.systems.registry import description_class, known_systems, setup_of

PLANNED = "planned"  # name of the run that was never recorded


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class Twin:
    """A model of a file, ready for commands that nobody has recorded.

    Attributes:
        saved: Content of the file.
        study: Study that the model was fitted to.
        run: Planned run: sample times and facts of its set-up.
        model: Plain model with its causes; parameters are centered at the file's values.
    """

    saved: SavedModel
    study: Study
    run: Run
    model: ExtendedModel

    @classmethod
    @checked
    def read(
        cls,
        path: str | Path | SavedModel,
        study: str | Path | Study,
        time_s: Array,
        setup: Mapping[str, Any] | None = None,
        start: Mapping[str, float] | None = None,
    ) -> Twin:
        """Make a twin of an ``extended_model.yaml``.

        Args:
            path: The file, or the folder that holds it, or its content.
            study: Study that it was fitted to, or its file: of formulas, of a multicopter, or of a
                soft body.
            time_s: Sample times of the run that is planned, (num_samples,) [s].
            setup: Facts of that run; what is not given is as in the first run of the study.
            start: What channels of a multicopter show where it starts, by name; what is not given
                is as at rest, level, at the origin. Its first commands have been held before.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a system whose commands have no gradient, or that starts as its description
                says; parts that the study's description does not have.
        """
        saved = path if isinstance(path, SavedModel) else read_extended(path)
        study = study if isinstance(study, Study) else load_study(study)
        described = _kind_of(study)
        first, time_s = study.runs[0], np.asarray(time_s, dtype=np.float64)
        shown = np.full((len(time_s), len(study.channels)), np.nan)
        if start and not described.starts_as_shown:
            raise ValueError(
                f"study {study.name} says itself how its runs start; leave out "
                f"`start: {{{', '.join(start)}}}`"
            )
        names = [c.name for c in study.channels]
        for name, value in (start or {}).items():
            shown[0, names.index(require_choice("start: channel", name, names))] = value
        run = Run(
            PLANNED,
            time_s,
            shown,
            {name: np.zeros(len(time_s)) for name in first.command},
            PLANNED,
            setup={**first.setup, **(setup or {})},
            columns={name: np.zeros(len(time_s)) for name in first.columns},
        )
        return cls._of(saved, study, run)

    @classmethod
    def _of(cls, saved: SavedModel, study: Study, run: Run) -> Twin:
        planned = saved.framed(replace(study, runs=(run,)))
        return cls(saved, study, run, rebuilt(saved, setup_of(planned)))

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the columns of what is simulated."""
        return tuple(c.name for c in self.study.channels)

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the causes that are built in."""
        return tuple(e.name for e in self.model.effects)

    @checked
    def simulate(self, commands: Mapping[str, Tensor], at: Tensor | None = None) -> Tensor:
        """What the channels would show.

        Args:
            commands: Each command at the sample times, (num_samples,).
            at: Standardized parameters as of ``draw``, (num_base,) or (K, num_base); None: the
                file's values.

        Returns:
            (num_samples, num_channels), or (K, num_samples, num_channels). Gradient: commands, at.
        """
        for name in self.run.command:
            require_choice("commands: command of the study", name, commands)
            require(f"command {name}", commands[name], ("...",), commands[name].dtype)
        q = self.model.at_prior() if at is None else at
        given: Any = {name: commands[name] for name in self.run.command}
        run = replace(self.run, command=given)
        if q.ndim == 1 or self.model.batched:
            return self.model.predict(run, q)
        return torch.stack([self.model.predict(run, one) for one in q])

    @checked
    def draw(self, count: int, rng: np.random.Generator) -> Tensor:
        """Standardized parameters and sizes that the data allow, (count, num_base)."""
        return self.saved.draw_coordinates(self.model.base, count, rng)

    def plain(self) -> Twin:
        """The plain model at its own fit to the same runs."""
        return self._of(without_effects(self.saved), self.study, self.run)

    @checked
    def with_share(self, share: float, causes: Collection[str] = ()) -> Twin:
        """A twin in which causes act with a share of their sizes; 0: mended.

        Args:
            share: Factor on the sizes.
            causes: Names of causes; empty: all.
        """
        causes = [as_spelled(name, self.causes) for name in causes]
        for name in causes:
            require_choice("causes", name, self.causes)
        mine = [c for c in self.saved.components if not causes or c.partition(".")[0] in causes]
        values = {n: share * v if n in mine else v for n, v in self.saved.values.items()}
        return self._of(replace(self.saved, values=values), self.study, self.run)


def _kind_of(study: Study) -> type[Description]:
    """How the study describes its system, whose commands must have gradients."""
    kind = str((study.model or {}).get("system"))
    what = f"twin of study {study.name}: model.system"
    described = description_class(require_choice(what, kind, known_systems()))
    if not described.commands_have_gradients:
        raise ValueError(
            f"{what} is {kind}, whose commands have no gradients; take one of formulas (ode), a "
            "multicopter, or a soft body"
        )
    return described
