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
