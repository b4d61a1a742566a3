"""Whole answers about studies, as a command makes them."""

from dataclasses import replace

import pytest

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.discover import screen
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


def found_beside_commands(study: Study) -> Report:
    """The same; at commands, where terms are simulated, laws are looked for in few places."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(screen, "MOST_SIMULATED", 4)
        return found(study)
