"""Does a pentacopter with noisy sensors hold its place, with and without a payload?

A flight in closed loop: sensors, LQR controller, pulses, motors, battery. ``diffsim fly`` does the
same from the command line.

Expected: 1.4 cm off its place in both, at most 19.1 A bare and 22.8 A with 300 g. It takes 5 s.

    python examples/copter/mission.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from diffsim.copter import load_design
from diffsim.copter.simulator import FlightSimulator, load_mission


def main(seconds: float = 5.0, payload: float = 0.3) -> dict[str, float]:
    """Numbers of the two flights."""
    design = load_design("pentacopter")
    found = {}
    for name, load in (("bare", 0.0), ("loaded", payload)):
        simulator = FlightSimulator(design, payload=load, seed=0)
        simulator.run(load_mission("hover"), seconds=seconds)
        numbers = simulator.log.summary()
        found[f"{name}, error cm"] = 1e2 * float(numbers["rms_position_error_m"])
        found[f"{name}, current A"] = float(numbers["greatest_current_A"])
    return found


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:28s} {value:.4f}")
