"""The virtual laboratories of ``labs.virtual`` as systems to be diagnosed.

Each file has a function ``setup(study)``, so that a study of a laboratory is diagnosed as any that
comes with its own model, from the clone's root::

    python -m diffsim diagnose explain STUDY --setup labs/systems/network.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffsim.core.check import require_choice
from diffsim.data.study import Study
from diffsim.identify.setup import DiagnosisSetup
from labs.systems import beam, copter, network

_BY_SYSTEM = {"soft_body": beam, "copter": copter, "stokes": network}


def setup_of(study: Study, **options: Any) -> DiagnosisSetup:
    """The setup of a laboratory's study.

    Args:
        study: Study made by a laboratory, whose ``system`` tells which one.
        **options: Options of that laboratory's ``setup``.

    Raises:
        ValueError: the study is of no laboratory.
    """
    return _BY_SYSTEM[require_choice("study.system", study.system, _BY_SYSTEM)].setup(
        study, **options
    )


def setup_file(name: str) -> Path:
    """The file with the setup of a laboratory, for ``--setup``.

    Args:
        name: "beam", "copter" or "network".
    """
    return Path(__file__).with_name(f"{name}.py")


__all__ = ["setup_file", "setup_of"]
