"""The progress of a search."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from diffsim.core.checked import checked
from diffsim.core.progress import show_progress
from diffsim.optim.evaluation import Callback, Progress


@checked
@contextmanager
def progress_bar(
    label: str, total: int | None, *, unit: float = 1.0, show: bool = True, leave: bool = True
) -> Iterator[Callback]:
    """A bar that counts evaluations and shows the least value; gives the callback that moves it.

    Args:
        label: Text before the bar.
        total: Largest number of evaluations; None: not known.
        unit: Unit in which the least value is shown.
        show: Whether to draw the bar at all.
        leave: Whether the bar stays when the search is over.
    """
    with show_progress(desc=label, total=total, leave=leave, disable=not show) as bar:

        def advance(progress: Progress) -> None:
            bar.set_postfix(best=f"{progress.best / unit:.4g}", refresh=False)
            bar.update()

        yield advance
