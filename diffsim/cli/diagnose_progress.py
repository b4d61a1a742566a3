"""Progress of a diagnosis, shown as a bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

from diffsim.core.progress import PERIOD_S, ProgressLines, show_progress
from diffsim.diagnose.say.tables import FIRST_LOOK
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
        start = last = 0.0

        def show(stage: str, fraction: float, message: str) -> None:
            # with finer steps, and with laws, a search begins anew: what is left is shared again
            nonlocal start, last
            if fraction < last - ANEW:
                start = bar.n / 100
            last = fraction
            share = start + OF_THE_REST * (1.0 - start) * min(max(fraction, 0.0), 1.0)
            bar.n = max(bar.n, min(round(100 * share), NEARLY))
            text = f"{stage} {message}".strip()
            if stage == FIRST_LOOK:  # a line of its own, which stays
                if stage not in begun:
                    bar.write(message)
                begun.add(stage)
            elif isinstance(bar, ProgressLines) and stage not in begun:
                begun.add(stage)
                bar.say(text)
            else:
                bar.set_postfix_str(text)

        ended = Event()
        ticker = Thread(target=_tick, args=(bar.refresh, ended), daemon=True)
        ticker.start()
        try:
            yield show
        finally:
            ended.set()
            ticker.join()
        bar.n = 100
        bar.refresh()


def _tick(refresh: Callable[[], object], ended: Event) -> None:
    """Show how long it has taken, whatever is silent meanwhile."""
    while not ended.wait(PERIOD_S):
        refresh()


OF_THE_REST = 0.7  # of the bar, that one search gets: another one may follow
NEARLY = 99  # percent that it shows at most before all is done, however often searches begin
ANEW = 0.3  # by which the share of a search falls where another one begins
_FORMAT = "{desc} |{bar:20}| {percentage:3.0f} % [{elapsed}{postfix}]"
