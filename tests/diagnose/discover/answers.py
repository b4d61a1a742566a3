"""Whole answers about studies, as a command makes them."""

from __future__ import annotations

from dataclasses import replace

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.say.report import Report
from diffsim.identify.effort import DiagnosisSettings
from diffsim.systems.registry import setup_of


def found(study: Study, *, accept_numerics: bool = False) -> Report:
    """What a diagnosis says, laws that nobody listed included."""
    made = setup_of(study)
    return diagnose(
        made.study or study,
        made.model,
        made.effects,
        seed=0,
        unknowns=made.unknowns,
        settings=replace(made.settings or DiagnosisSettings(), accept_numerics=accept_numerics),
        laws=made.laws,
    )
