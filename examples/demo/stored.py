"""Answers that are dear to compute and come with the demo: fits to motion, and the diagnosis.

They are of the measured and of the virtual beam, and of the full plan; of other recordings and
sizes everything is computed. ``diffsim demo --all`` computes them again and says how far they are
off; then ``python -m examples.demo.store runs/demo RECORDINGS`` writes their file anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffsim.core.files import file_digest, read_kept
from examples.data.beam import BeamStudy
from examples.demo.plan import Plan

FOLDER = Path(__file__).with_name("answers")  # a file for each set of recordings
STAGES = ("identified", "joint", "diagnosis")


@dataclass(frozen=True)
class Stored:
    """Answers of some stages."""

    commit: str = ""  # commit whose code computed them; empty without answers
    results: Mapping[str, Any] = field(default_factory=dict)  # by stage

    def words(self) -> list[str]:
        """Where they come from, for the page; nothing without answers."""
        if not self.results:
            return []
        what = "Fits to the motion"
        if "diagnosis" in self.results:
            what += " and the diagnosis"
        return [
            f"{what} are stored answers of these recordings, computed at commit {self.commit}. All "
            "else was computed now. `./scripts/demo --all` computes them again and says how far "
            "they are off."
        ]


def asked(study: BeamStudy, plan: Plan) -> dict[str, str]:
    """What answers belong to: the contents of the recordings, and the sizes of everything."""
    files = [study.folder / "metadata.yaml", *(t.recording.source for t in study.trials)]
    return {"plan": repr(plan), "data": file_digest([path for path in files if path is not None])}


def answers(question: Mapping[str, str], folder: Path | None = None) -> Stored:
    """Stored answers to what is asked; none where recordings or sizes are others.

    Args:
        question: As of ``asked``.
        folder: Folder of their files; None: the one beside this module.
    """
    for path in sorted((folder or FOLDER).glob("*.json")):
        content = read_kept(path) or {}
        if content.get("of") == question:
            return Stored(content["commit"], content["results"])
    return Stored()


def distances(stored: Stored, results: Mapping[str, Any]) -> list[str]:
    """How far answers that were computed now are from the stored ones, a sentence each.

    Args:
        stored: Answers for the same recordings and sizes.
        results: Of the run.
    """
    said = []
    for name, before in stored.results.items():
        now = results[name]
        if "value" in before:
            off = max(abs(now["value"][k] / v - 1.0) for k, v in before["value"].items())
            said.append(f"{name}: within {100 * off:.2g} % of the answer of {stored.commit}")
        else:
            same = before["named"] == now["named"] and before["verdict"] == now["verdict"]
            words = "the same causes as" if same else "other causes than"
            said.append(f"{name}: {words} at {stored.commit}")
    return said
