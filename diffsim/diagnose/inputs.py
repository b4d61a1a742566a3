"""Inputs of one diagnosis, and a hash of them: equal hashes give equal answers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from diffsim.core.files import to_plain
from diffsim.data.study import Study
from diffsim.identify.setup import DiagnosisSetup


@dataclass(frozen=True, eq=False)
class Inputs:
    """Study, setup, seed and settings, which together decide the answer."""

    study: Study  # recorded runs with their channels and commands
    setup: DiagnosisSetup  # model, causes, unknowns, bank, settings; as chosen
    seed: int  # seed of the bootstrap
    # hashes and names by what they are of; equal ones give equal answers
    fingerprint: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The fingerprint in one short word."""
        text = json.dumps(to_plain(dict(self.fingerprint)), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]
