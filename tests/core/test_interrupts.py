"""Interruptions: SIGINT and SIGTERM end a script alike, in one line, with its own status."""

import signal
import subprocess
import sys

import pytest

from diffsim.core.interrupts import postponed_interrupts

pytestmark = pytest.mark.serial  # interrupts processes

SCRIPT = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start jobs in the background deaf
from diffsim.core.interrupts import interruptible
with interruptible("go on with --resume"):
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_script_ends_in_one_line(number):
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    assert process.returncode == 130
    assert said.strip() == "interrupted; go on with --resume"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_must_be_done_whole_is_interrupted_after_it(number):
    said, before = [], signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), postponed_interrupts():
            signal.raise_signal(number)
            said.append("written")
        assert said == ["written"]
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)


LOADING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from diffsim.core.interrupts import terminate_as_interrupt
terminate_as_interrupt()
swallows = '''
try:
    signal.raise_signal(signal.{name})
except BaseException:
    pass
'''
exec(compile(swallows, "it", "exec"), {{"__name__": "{module}", "signal": signal}})
print("went on")
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_it_is_heard_while_a_package_loads_that_swallows_exceptions(name):
    for module, expected in (("torch.optional", 130), ("elsewhere", 0)):
        code = LOADING.format(name=name, module=module)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == expected, done.stderr
        assert ("interrupted" in done.stderr) != ("went on" in done.stdout)
