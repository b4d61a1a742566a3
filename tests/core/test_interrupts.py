"""Interruptions: SIGINT and SIGTERM end a script alike, in one line, with its own status."""

import signal
import subprocess
import sys
import time

import pytest
import torch

from diffsim.copter import load_design
from diffsim.copter.dynamics.flight import fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.core.interrupts import postponed_interrupts
from diffsim.ode import Ode

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
exec(compile(swallows, "{file}", "exec"), {{"__name__": "{module}", "signal": signal}})
print("went on")
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_it_is_heard_while_a_package_loads_that_swallows_exceptions(name):
    for module, file, expected in (
        ("torch.optional", "it", 130),
        ("elsewhere", "/lib/site-packages/elsewhere/it.py", 130),
        ("elsewhere", "it", 0),
    ):
        code = LOADING.format(name=name, module=module, file=file)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == expected, done.stderr
        assert ("interrupted" in done.stderr) != ("went on" in done.stdout)


def solve():
    ode = Ode(rates={"x": "v", "v": "-k*x"}, readings={"p": "x"}, inputs=[], parameters=["k"])
    times = torch.tensor([0.0, 1e3], dtype=torch.float64)
    start, k = torch.ones(2, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    return lambda: ode.solve(times, start, times.new_empty(2, 0), k, num_steps=400_000_000)


def gradient_of_solve():
    ode = Ode(rates={"x": "-k*x"}, readings={"p": "x"}, inputs=[], parameters=["k"])
    times = torch.linspace(0.0, 1.0, 50_001, dtype=torch.float64)
    k = torch.ones(1, dtype=torch.float64, requires_grad=True)
    start, inputs = times.new_ones(1), times.new_empty(len(times), 0)
    return ode.solve(times, start, inputs, k, num_steps=100)[0].sum().backward


def fly_long():
    vehicle = load_design("quadcopter").multicopter()
    commands = torch.full((1, 2, vehicle.num_rotors), 1.0, dtype=torch.float64)
    start = FlightState.at_rest(torch.zeros(1, 3, dtype=torch.float64))
    return lambda: fly(vehicle, start, commands, dt=1.0, substeps=50_000_000)


def fly_many():
    vehicle = load_design("quadcopter").multicopter()
    commands = torch.full((16, 2, vehicle.num_rotors), 1.0, dtype=torch.float64)
    start = FlightState.at_rest(torch.zeros(16, 3, dtype=torch.float64))
    return lambda: fly(vehicle, start, commands, dt=1.0, substeps=50_000_000, num_threads=2)


@pytest.mark.parametrize("prepare", [solve, gradient_of_solve, fly_long, fly_many])
def test_ctrl_c_is_heard_within_a_long_kernel(prepare):
    """A flight of 10^8 steps was interrupted when it had ended, after minutes."""
    call = prepare()
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    began = time.monotonic()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt):
            call()
        assert time.monotonic() - began < 3.0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
