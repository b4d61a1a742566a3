"""Fits of published sets with chosen causes."""

from diffsim.identify import fit
from diffsim.systems.registry import setup_of


def fitted(study, *names):
    """The fit of a study with some of its causes, by name."""
    setup = setup_of(study)
    chosen = [e for e in setup.effects if e.name in names]
    assert len(chosen) == len(names)
    return fit(setup.model, study.fit_runs, study.channels, effects=chosen, max_evaluations=60)
