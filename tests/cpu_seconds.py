"""CPU seconds of each test: the dearest are shown, and one beyond its limit fails the run.

Counted are the test, its fixtures, and the processes that it started and waited for. A fixture of a
module counts for the first test that asks for it. Limits are stated for a quiet core of the machine
that `REFERENCE_S` was measured on; a slower or busier one has as much more as it needs for the
yardstick, which is run beside each test that would fail.
"""

import os
import time
from collections import defaultdict
from collections.abc import Iterable

import pytest

from tests import warm

BEGAN = time.time()
"""When this process began to look for tests."""
LIMIT_S = 5.0
"""CPU seconds that a test may take without a mark that says otherwise."""
REFERENCE_S = 0.034
"""CPU seconds of the yardstick on a quiet core (Zen 5, Python 3.11)."""
SCATTER = 1.5
"""Of one test's seconds, beyond what the yardstick tells: 6.6 s alone were 9.9 s beside others."""
DEAREST = 20
OTHER_TIERS = ("slow", "story")
SECONDS = "cpu_s"
ALLOWED = "allowed_cpu_s"


def used_s() -> float:
    """CPU seconds of this process, of those that it waited for, and of the warm one's."""
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system + warm.used_s()


def yardstick_s() -> float:
    """CPU seconds that a fixed piece of Python takes here and now."""
    began = time.process_time()
    table: dict[int, float] = {}
    for i in range(400_000):
        table[i % 1024] = table.get(i % 1024, 0.0) + 0.5 * i
    return time.process_time() - began


def slowness() -> float:
    """How many times slower than the reference this machine is now, at least 1."""
    return max(1.0, yardstick_s() / REFERENCE_S)


def stated_limit_s(item: pytest.Item) -> float:
    """CPU seconds that a test may take on the reference machine."""
    if any(item.get_closest_marker(tier) for tier in OTHER_TIERS):
        return float("inf")
    mark = item.get_closest_marker("cpu")
    return LIMIT_S if mark is None else float(mark.args[0])


class CpuSeconds:
    """Plugin of workers and of the process that reports; the latter sums up."""

    def __init__(self) -> None:
        self.began: dict[str, float] = {}
        self.used: dict[str, float] = {}
        self.allowed: dict[str, float] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.began[nodeid] = used_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]):
        if call.when == "teardown":
            seconds = used_s() - self.began.pop(item.nodeid)
            item.user_properties.append((SECONDS, seconds))
            limit = stated_limit_s(item)
            if seconds > limit:
                item.user_properties.append((ALLOWED, limit * SCATTER * slowness()))
        return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            said = dict(report.user_properties)
            if SECONDS in said:
                self.used[report.nodeid] = float(str(said[SECONDS]))
            if ALLOWED in said:
                self.allowed[report.nodeid] = float(str(said[ALLOWED]))

    def too_dear(self) -> dict[str, float]:
        """Tests beyond what they may take here, and that [CPU s]."""
        return {name: most for name, most in self.allowed.items() if self.used[name] > most}

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.too_dear() and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        write = terminalreporter.write_line
        if sum(self.used.values()) >= LIMIT_S:
            terminalreporter.section("CPU seconds")
            for line in table(self.used):
                write(line)
        for name, most in self.too_dear().items():
            write(
                f"FAILED {name}: {self.used[name]:.1f} CPU s, at most {most:.1f} here; make it "
                "cheaper, or mark it: cpu(seconds) with the reason, story, slow",
                red=True,
            )


def table(used: dict[str, float]) -> Iterable[str]:
    """Lines: the dearest tests, then the sum of each room."""
    for name, seconds in sorted(used.items(), key=lambda pair: -pair[1])[:DEAREST]:
        yield f"{seconds:8.1f} s  {name}"
    rooms: dict[str, float] = defaultdict(float)
    for name, seconds in used.items():
        rooms["/".join(name.split("::")[0].split("/")[:2])] += seconds
    ordered = sorted(rooms.items(), key=lambda pair: -pair[1])
    yield "rooms: " + ", ".join(f"{room} {seconds:.0f}" for room, seconds in ordered)
    yield f"all {len(used)} tests: {sum(used.values()):.0f} CPU s"
