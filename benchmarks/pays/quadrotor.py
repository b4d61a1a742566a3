"""A quadrotor of RotorPy, which shares no code with the simulators here, flown in a vertical plane.

Its autopilot holds a pitch and adds a lift to that of hover, 100 times in a second. What its data
sheet omits: the rear rotors are weak, commands come late, and air drags at the rotors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.pays.draws import about, off

Array = NDArray[np.float64]
LOOP = 1e-2  # time between two commands to the motors [s]
MASS, GRAVITY = 0.5, 9.81  # as the autopilot knows them [kg, m/s^2]
STIFFNESS, DAMPING = 0.365, 0.058  # of the autopilot [N m/rad, N m s/rad]


@dataclass(frozen=True, eq=False)
class Quadrotor:
    """A vehicle with what was hidden in it."""

    numbers: dict[str, Any]  # RotorPy's, by name
    weak: float  # share of their thrust that the rear rotors have lost
    late_s: float  # time by which commands come later [s]

    def record(self, time_s: Array, commands: Sequence[Array]) -> Array:
        """Way ahead [m], height [m] and pitch [rad] without noise, (num_samples, 3)."""
        vehicle, state = self._vehicle()
        per_sample = round(float(time_s[1] - time_s[0]) / LOOP)
        lift, wanted = (
            np.interp(
                time_s[0] + np.arange((len(time_s) - 1) * per_sample) * LOOP - self.late_s,
                time_s,
                c,
            )
            for c in commands
        )
        rows = [self._seen(state)]
        for step in range(len(lift)):
            moment = STIFFNESS * (wanted[step] - self._pitch(state)) - DAMPING * state["w"][1]
            asked = {"cmd_motor_speeds": self._speeds(MASS * GRAVITY + lift[step], moment)}
            state = vehicle.step(state, asked, LOOP)
            if (step + 1) % per_sample == 0:
                rows.append(self._seen(state))
        return np.array(rows)

    def _vehicle(self) -> tuple[Any, dict[str, Array]]:
        from rotorpy.vehicles.multirotor import Multirotor

        weak = self.weak

        class Vehicle(Multirotor):
            """With weak rear rotors."""

            def compute_body_wrench(self, rates: Array, speeds: Array, air: Array) -> Any:
                share = np.where(self.rotor_geometry[:, 0] < 0, 1.0 - weak, 1.0)
                return super().compute_body_wrench(rates, speeds * np.sqrt(share), air)

        zero = np.zeros(3)
        state = {"x": zero, "v": zero, "q": np.array([0.0, 0, 0, 1]), "w": zero, "wind": zero}
        return Vehicle(self.numbers), state | {"rotor_speeds": self._speeds(MASS * GRAVITY, 0.0)}

    def _speeds(self, thrust: float, moment: float) -> Array:
        """Of the rotors [rad/s], by the autopilot's mixer; a moment above zero lowers the nose."""
        ahead = np.array([place[0] for place in self.numbers["rotor_pos"].values()])
        each = thrust / 4.0 - moment / (4.0 * ahead)
        return np.sqrt(np.maximum(each, 0.0) / self.numbers["k_eta"])

    @staticmethod
    def _pitch(state: dict[str, Array]) -> float:
        return 2.0 * float(np.arctan2(state["q"][1], state["q"][3]))

    def _seen(self, state: dict[str, Array]) -> Array:
        return np.array([state["x"][0], state["x"][2], self._pitch(state)])


def quadrotor(rng: np.random.Generator) -> Quadrotor:
    """A quadrotor; its rear rotors are weak, commands come late, and air drags at the rotors."""
    from rotorpy.vehicles.hummingbird_params import quad_params

    still = dict.fromkeys(("c_Dx", "c_Dy", "c_Dz", "k_z", "k_h", "k_flap"), 0.0)
    numbers = {
        **quad_params,
        **still,
        "mass": off(rng, MASS, 1.0),
        "Iyy": off(rng, quad_params["Iyy"], 5.0),
        "k_d": about(rng, quad_params["k_d"]),
    }
    return Quadrotor(numbers, weak=about(rng, 0.06), late_s=about(rng, 0.04))
