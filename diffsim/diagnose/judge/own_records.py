"""What was fitted to an unseen run, as records: values of its own, and the error without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from diffsim.core.units import after_number, factor, small_unit

UNTOLD_PULL = 0.01  # prior sd; nearer to its prior nothing was said of a value
FAR_OFF = 3.0  # prior sd from which on a value that was fitted to a run is no usual one


@dataclass(frozen=True)
class OwnRow:
    """A value that was fitted to one run that nothing else was fitted to.

    Attributes:
        run: Name of the run.
        name: Name of the parameter, such as "offset@run_9".
        unit: SI unit, "-" if none.
        value: Where it ended, in ``unit``.
        prior_value, prior_sd: What the study states of it, in ``unit``.
        pull: How far it ended from that [prior sd], with sign.
    """

    run: str
    name: str
    unit: str
    value: float
    prior_value: float
    prior_sd: float
    pull: float

    @property
    def is_told(self) -> bool:
        """Whether the run says anything of it: a shape of a cause that is absent is not."""
        return abs(self.pull) > UNTOLD_PULL

    @property
    def words(self) -> str:
        """The row in a clause."""
        shown = small_unit(self.unit, (self.value, self.prior_value, self.prior_sd))
        times = 1.0 if shown == self.unit else factor(self.unit, shown)
        value, prior, sd = (times * v for v in (self.value, self.prior_value, self.prior_sd))
        unit = after_number(shown)
        name = self.name.partition("@")[0].rstrip(".").replace("_", " ")
        stated = f"{prior:.4g} +- {sd:.2g}{unit}"
        return f"{name} {value:.4g}{unit}, stated {stated}: {abs(self.pull):.2g} sd off"


def own_words(rows: Sequence[OwnRow]) -> list[str]:
    """Values that ended far from what is stated of them, a sentence for each run.

    Args:
        rows: Values of all runs.
    """
    far: dict[str, list[str]] = {}
    for row in rows:
        if abs(row.pull) > FAR_OFF:
            far.setdefault(row.run, []).append(row.words)
    return [
        f"Run {run} was fitted far from what the study states: {'; '.join(words)}."
        for run, words in far.items()
    ]
