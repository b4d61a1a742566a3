"""Sessions of recording, between which somebody may have changed something."""

from __future__ import annotations

from dataclasses import dataclass

from diffsim.data.study import Run, Study

SESSIONS = "sessions"  # place in a study's frame: labels of the runs that were fitted


@dataclass(frozen=True)
class Sessions:
    """Groups of runs between which somebody may have changed something.

    Attributes:
        fact: Fact of the runs' ``setup`` that says in which session they were recorded.
        labels: Its values; the first session is as described.
    """

    fact: str
    labels: tuple[str, ...]

    @classmethod
    def of(cls, fact: str | None, study: Study) -> Sessions | None:
        """Sessions of a study's runs, those of the fitted ones where a frame says which they were;
        None: there are not two.

        Args:
            fact: Name of the fact; None: none is stated.
            study: Study with the runs.
        """
        if fact is None:
            return None
        labels = study.frame.get(SESSIONS) or {
            str(run.setup[fact]) for run in study.runs if fact in run.setup
        }
        return cls(fact, tuple(sorted(labels))) if len(labels) > 1 else None

    def index_of(self, run: Run) -> int | None:
        """Place of a run's session among the later ones; None: the first, or one that was never
        fitted, which is as described.

        Args:
            run: Run that is simulated.
        """
        label = str(run.setup.get(self.fact, self.labels[0]))
        return self.labels.index(label) - 1 if label in self.labels[1:] else None
