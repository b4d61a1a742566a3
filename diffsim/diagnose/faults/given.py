"""What a study states for its faults, checked against its runs and its model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from diffsim.core.check import as_spelled
from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Study
from diffsim.diagnose.faults.candidates import sets_of
from diffsim.diagnose.faults.groups import Group, groups_of
from diffsim.diagnose.faults.layout import Layout, layout_of
from diffsim.identify.setup import DiagnosisSetup


@dataclass(frozen=True, eq=False)
class FaultStudy:
    """A study with ``faults``, taken apart."""

    keys: FaultKeys  # ``faults`` of the study
    groups: tuple[Group, ...]  # its groups of runs
    layout: Layout  # where the base parameters of its model belong
    sets: tuple[tuple[str, ...], ...]  # sets of causes that may act at once


def take_apart(study: Study, setup: DiagnosisSetup) -> FaultStudy:
    """What a study states for its faults; nothing is simulated.

    Raises:
        ValueError: the study has no ``faults``, or they name what is not there.
    """
    keys = study.faults
    if keys is None:
        raise ValueError("the study has no `faults`; see `faults` in docs/study_keys.md")
    spelled = partial(as_spelled, known=[e.name for e in setup.effects])
    causes = {what: tuple(map(spelled, own)) for what, own in keys.known.causes.items()}
    keys = keys.model_copy(
        update={
            "known": keys.known.model_copy(update={"causes": causes}),
            "together": tuple(map(spelled, keys.together)),
            "sizes": {spelled(name): size for name, size in keys.sizes.items()},
        }
    )
    sets = sets_of(keys, setup.effects)
    return FaultStudy(keys, groups_of(study, keys), layout_of(setup.model.base, keys), sets)
