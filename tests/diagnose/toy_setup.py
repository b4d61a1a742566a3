"""The toy as a setup file: ``diffsim diagnose explain STUDY --setup toy_setup.py``."""

from dataclasses import replace

from diffsim.data.study import Run, Study
from diffsim.identify import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from tests.diagnose import toy

EFFECTS = (toy.DRAG, toy.DELAY, toy.BIAS, toy.SCALE)


def setup(study: Study, **_options: object) -> DiagnosisSetup:
    """Model and causes of the toy; the bank repeats each command, large and small."""
    return DiagnosisSetup(
        model=toy.model(study.runs),
        effects=EFFECTS,
        unknowns=(toy.unknown_force(),),
        bank=bank(study),
        settings=DiagnosisSettings(search=SearchSettings(num_refits=2)),
    )


def bank(study: Study) -> tuple[Run, ...]:
    """Runs that could be recorded."""
    first = study.runs[0]
    return tuple(
        replace(first, name=f"{name}_{scale:g}", command={"u": scale * command}, group=name)
        for name, command in toy.COMMANDS.items()
        for scale in (0.3, 1.0)
    )
