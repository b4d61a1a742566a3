"""Progress of a diagnosis, shown as a bar."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from diffsim.core.progress import ProgressLines, show_progress
from diffsim.diagnose.search.fit import Progress


@contextmanager
def progress_bar(title: str, *, quiet: bool = False) -> Iterator[Progress]:
    """A bar over the whole, with stage and message beside it; a log has a line for each stage.

    Args:
        title: Text before the bar.
        quiet: Whether to show nothing.
    """
    with show_progress(total=100, desc=title, unit="%", disable=quiet, bar_format=_FORMAT) as bar:
        begun: set[str] = set()

        def show(stage: str, fraction: float, message: str) -> None:
            bar.n = round(100 * min(max(fraction, 0.0), 1.0))
            text = f"{stage} {message}".strip()
            if isinstance(bar, ProgressLines) and stage not in begun:
                begun.add(stage)
                bar.say(text)
            else:
                bar.set_postfix_str(text)

        yield show
        bar.n = 100
        bar.refresh()


_FORMAT = "{desc} |{bar:20}| {percentage:3.0f} % [{elapsed}{postfix}]"
