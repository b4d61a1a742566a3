"""What every run of the tests does: threads, how workers share the files, CPU seconds counted."""

import gc
import os
import sys
import time
from collections import Counter
from pathlib import Path

# Two workers of one thread each; libraries read these when they are first loaded.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# As scripts/test does: each worker and each process that a test starts would compile all anew.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    bytecode = str(Path(__file__).resolve().parents[1] / "build" / "bytecode")
    sys.pycache_prefix = os.environ.setdefault("PYTHONPYCACHEPREFIX", bytecode)
    sys.dont_write_bytecode = False

import pytest  # noqa: E402

from tests.cpu_seconds import CpuSeconds  # noqa: E402

COLLECTION_S = pytest.StashKey[float]()
"""CPU seconds of this process up to its first test."""
TESTS = Path(__file__).parent
STORY_ROOMS = {
    TESTS / room
    for room in ("benchmarks", "copter/fabrication", "examples", "labs", "rl", "systems/published")
}
"""Rooms of the tier ``story``: studies, and scripts beside the library. A run that names one of
them, or a file there, has it all the same."""


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(CpuSeconds())


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the rooms of stories where stories are left out and the room is not named."""
    if "not story" not in config.option.markexpr or collection_path not in STORY_ROOMS:
        return None
    named = (config.invocation_params.dir / arg.partition("::")[0] for arg in config.args)
    return None if any(path.resolve().is_relative_to(collection_path) for path in named) else True


@pytest.fixture(autouse=True, scope="session")
def logs_of_stable_baselines3(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Examples train as a user would, without a logger: a folder in /tmp for each otherwise."""
    os.environ.setdefault("SB3_LOGDIR", str(tmp_path_factory.mktemp("logs")))


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session):
    """Collect without the garbage collector: what is imported stays, and looking through it took
    a third of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.freeze()
    session.config.stash[COLLECTION_S] = time.process_time()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]):
    """Group what must not run beside its like; for workers, put files of few tests first.

    Those are the dear ones, and a dear file at the end would keep one worker waiting. What is left
    out beside a story is told once all others have chosen.
    """
    for item in items:
        if item.get_closest_marker("serial"):
            item.add_marker(pytest.mark.xdist_group("serial"))
    if hasattr(config, "workerinput"):
        tests = Counter(item.location[0] for item in items)
        items.sort(
            key=lambda item: (not item.get_closest_marker("serial"), tests[item.location[0]])
        )
    yield
    chosen = {item.nodeid for item in items}
    beside = [item for item in items if is_in_story(item, chosen)]
    if beside:
        items[:] = [item for item in items if item not in beside]
        config.hook.pytest_deselected(items=beside)


def is_in_story(item: pytest.Item, chosen: set[str]) -> bool:
    """Whether a story that runs states all that this short form of it does."""
    mark = item.get_closest_marker("short_of")
    file = item.nodeid.partition("::")[0]
    return mark is not None and any(f"{file}::{story}" in chosen for story in mark.args)


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object | None:
    """Deal whole files to the workers, and the group of serial tests to one of them."""
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            group = nodeid.rpartition("]")[2].partition("@")[2]
            return group or nodeid.partition("::")[0]

    return ByFile(config, log)
