"""Extended models read back: a saved file, and the system that its study names."""

from __future__ import annotations

from pathlib import Path

from diffsim.data.study import Study
from diffsim.identify.extended import ExtendedModel
from diffsim.identify.model_file import read_extended, rebuilt
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.registry import setup_of


def load_extended(
    path: str | Path, study: Study, *, setup: DiagnosisSetup | None = None
) -> ExtendedModel:
    """The saved model, ready to be simulated, differentiated or fitted further.

    Args:
        path: ``extended_model.yaml`` or the folder that holds it.
        study: Study of the system; its setup gives the plain model and the effects by name.
            Nuisances of runs that the file does not know ("offset@run_9") keep their prior.
        setup: Setup to use in place of the study's own.

    Returns:
        A model whose priors are centered at the saved values.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an effect or parameter that the setup does not have; the message names the
            closest ones.
    """
    return rebuilt(read_extended(path), setup_of(study) if setup is None else setup)
