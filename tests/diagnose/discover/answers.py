"""Whole answers about studies, as a command makes them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.discover import screen, stage
from diffsim.diagnose.say.report import Report
from diffsim.identify.effort import DiagnosisSettings
from diffsim.systems.registry import setup_of


def found(study: Study, *, with_laws: bool = True, accept_numerics: bool = False) -> Report:
    """What a diagnosis says; by itself it looks for laws that nobody listed, too."""
    made = setup_of(study)
    return diagnose(
        made.study or study,
        made.model,
        made.effects,
        seed=0,
        unknowns=made.unknowns,
        settings=replace(made.settings or DiagnosisSettings(), accept_numerics=accept_numerics),
        laws=made.laws if with_laws else None,
    )


def answer(study: Study) -> Report:
    """What a diagnosis says of the causes of the library alone."""
    return found(study, with_laws=False)


@contextmanager
def few_laws() -> Iterator[None]:
    """Of each screen two laws are fitted in the simulator; of commands few terms are simulated."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(screen, "MOST_SIMULATED", 4)
        patch.setattr(stage, "NUM_FITTED", 2)
        yield


@contextmanager
def no_laws() -> Iterator[None]:
    """Laws that nobody listed are found nowhere, at once."""
    with pytest.MonkeyPatch.context() as patch:
        none = stage.FoundLaws((), (), (), 0)
        patch.setattr("diffsim.diagnose.diagnosis.find_laws", lambda *_: none)
        yield
