"""Virtual laboratory of a flow distributor: one pump, three outlets, a plane network of channels.

Lubrication theory: every channel is a slit, flow ~ width^3 dp / (12 viscosity length) with the
exact corrections for slip, power-law fluids and compliant walls; pressures at the two junctions
from conservation of mass (root finding with scipy). No grid, no level set: it shares nothing with
the Stokes solver.

::

    pump ==inlet== J1 ==link== J2 ==branch 2== outlet 2 (at atmosphere)
                   ||          ``==branch 3== outlet 3 (at atmosphere)
                   ``==branch 1== outlet 1 (at a commanded back pressure)

Every sample is a steady state at one level of the pump. Not modelled: losses in the junctions
(they look like longer channels), start-up of the flow.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, root

from diffsim.data.labs.common import Base, Lab, LabEffect, Plan, size_of, vector_of
from diffsim.data.study import Channel
from diffsim.errors import DiffsimError

Array = NDArray[np.float64]

DEPTH_M = 1e-3  # out of the plane; flows are plane flows times this
CHANNELS = ("inlet", "link", "branch_1", "branch_2", "branch_3")
WIDTH_M = np.array([500e-6, 400e-6, 260e-6, 240e-6, 300e-6])
LENGTH_M = np.array([6e-3, 4e-3, 8e-3, 7e-3, 9e-3])
DENSITY_KG_M3 = 1000.0
SHEAR_REFERENCE_1_S = 100.0  # where the thinning fluid has the stated viscosity
CRACKING_PA = 40.0
_SENSORS = (
    *((f"outlet_{i}_m3_s", "m3/s", "flow", 2e-11) for i in (1, 2, 3)),
    ("pump_Pa", "Pa", "pressure", 0.1),
    ("junction_Pa", "Pa", "pressure", 0.1),
)


class NetworkLab(Lab):
    """See the module; channels are the flows at the outlets, pump and junction pressure."""

    system: ClassVar[str] = "stokes"
    setup: ClassVar[str] = "lab_network"
    channels: ClassVar[tuple[Channel, ...]] = tuple(Channel(*s) for s in _SENSORS)
    base: ClassVar[dict[str, Base]] = {
        "viscosity": Base(1.0e-3, 0.03, "Pa s"),
        **{f"width_{n}": Base(float(w), 0.01, "m") for n, w in zip(CHANNELS, WIDTH_M, strict=True)},
    }
    effects: ClassVar[dict[str, LabEffect]] = {
        "slip": LabEffect("m", 3e-6, "slip length: flow times 1 + 6 size / width"),
        "wall_offset": LabEffect("m", 4e-6, "every wall moved outwards: width + 2 size"),
        "viscosity": LabEffect("-", 0.1, "viscosity times 1 + size"),
        "temperature_gradient": LabEffect("-", 0.05, "viscosity of branches 1, 2, 3: 1 -+ size"),
        "compliance": LabEffect("1/Pa", 1e-3, "width times 1 + size pressure"),
        "thinning": LabEffect("-", 0.1, "power law, exponent 1 - size"),
        "inertia": LabEffect("-", 5.0, "loss of size rho u^2 / 2 at each branch's entrance"),
        "leak": LabEffect("m3/(s Pa)", 1e-11, "from junction 1 to atmosphere"),
        "pump_gain": LabEffect("-", 0.03, "the pump gives 1 + size times the set flow"),
        "meter_gain": LabEffect("-", 0.03, "the meters read 1 + size times the flow", 3),
        "blocked_branch": LabEffect("-", 0.1, "flow of one branch times 1 - size", 3),
        "pressure_offset": LabEffect("Pa", 5.0, "back pressure at one outlet", 3),
        "pressure_scale": LabEffect("-", 0.03, "pressure sensors read 1 + size times"),
        "cracking": LabEffect("-", 1.0, "branch 3 opens above 40 Pa only", outside=True),
    }

    def plans(self, rng: np.random.Generator) -> list[Plan]:
        t: Array = np.arange(60, dtype=np.float64)
        level = 1e-8
        commands: dict[str, tuple[Array, float]] = {
            "low": (0.25 * level * (1.0 + np.sin(2 * np.pi * t / 60.0 - 1.2)), 0.0),
            "staircase": (level * (0.2 + 0.2 * np.floor(t / 6.0)), 0.0),
            "back_pressure": (np.full(60, 1.0 * level), 6.0),
        }
        plans = []
        for repeat in "ab":
            for name, (pump, rise) in commands.items():
                back = rise * np.floor(t / 10.0)
                plans.append(_plan(f"{name}_{repeat}", name, "fit", t, pump, back))
        unseen = level * (1.2 + 0.8 * np.sin(2 * np.pi * t / 23.0))
        raised = np.where(t > 30.0, 20.0, 0.0)
        return [*plans, _plan("mixed", "mixed", "holdout", t, unseen, raised)]

    def nuisances(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "meter_gain": rng.normal(0.0, 0.005, 3),
            "pressure_zero_Pa": rng.normal(0.0, 0.2, 2),
        }

    def measure(self, plan: Plan, truth: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        """Flows and pressures at every level."""
        network = _Network(truth)
        pump = truth["gain"] * (1.0 + size_of(truth, "pump_gain")) * plan.command["pump_m3_s"]
        out = np.empty((len(pump), 5))
        guess = np.zeros(2)
        for i, (flow, back) in enumerate(zip(pump, plan.command["outlet_1_Pa"], strict=True)):
            out[i], guess = network.steady(float(flow), float(back), guess)
        out[:, :3] *= 1.0 + truth["nuisances"]["meter_gain"] + vector_of(truth, "meter_gain", 3)
        out[:, 3:] *= 1.0 + size_of(truth, "pressure_scale")
        out[:, 3:] += truth["nuisances"]["pressure_zero_Pa"]
        return out, dict(plan.command)

    def facts(self) -> dict[str, Any]:
        return {
            "geometry": {
                "channels": list(CHANNELS),
                "width_m": WIDTH_M,
                "length_m": LENGTH_M,
                "depth_m": DEPTH_M,
                "depth_meaning": "flows are plane flows (m2/s) times the depth",
                "connections": "inlet: pump-J1; link: J1-J2; branch_1: J1-outlet 1; "
                "branch_2: J2-outlet 2; branch_3: J2-outlet 3",
            },
            "density_kg_m3": DENSITY_KG_M3,
            "time": "every sample is a steady state; time_s counts them",
            "nuisances": {"meter_gain_sd": 0.005, "pressure_zero_sd_Pa": 0.2},
        }


class _Network:
    """Flows of the true network."""

    def __init__(self, truth: dict[str, Any]):
        base, self.truth = truth["base"], truth
        offset = 2.0 * size_of(truth, "wall_offset")
        self.width = np.array([base[f"width_{name}"] for name in CHANNELS]) + offset
        warmth = size_of(truth, "temperature_gradient") * np.array([0.0, 0.0, -1.0, 0.0, 1.0])
        self.viscosity = base["viscosity"] * (1.0 + size_of(truth, "viscosity")) * (1.0 + warmth)
        self.slip = 1.0 + 6.0 * size_of(truth, "slip") / self.width
        self.open = np.concatenate([[1.0, 1.0], 1.0 - vector_of(truth, "blocked_branch", 3)])
        self.back = vector_of(truth, "pressure_offset", 3)
        self.exponent = 1.0 - size_of(truth, "thinning")
        self.compliance = size_of(truth, "compliance")
        self.loss = size_of(truth, "inertia")
        self.leak = size_of(truth, "leak")
        self.cracking = CRACKING_PA * size_of(truth, "cracking")

    def steady(self, pump: float, outlet_1: float, guess: Array) -> tuple[Array, Array]:
        """Outlet flows [m^3/s], pump and junction pressure [Pa]; and the junction pressures."""
        scale = max(abs(pump), 1e-10)
        back = self.back + np.array([outlet_1, 0.0, 0.0])

        def flows(p: Array) -> tuple[float, float, float, float]:
            link = self.flow(1, p[0], p[1])
            branch_1 = self.flow(2, p[0], back[0])
            branch_2 = self.flow(3, p[1], back[1])
            return link, branch_1, branch_2, self.flow(4, p[1], back[2])

        def unbalance(p: Array) -> Array:
            link, one, two, three = flows(p)
            return np.array([pump - link - one - self.leak * p[0], link - two - three]) / scale

        found = root(unbalance, guess, method="hybr", options={"xtol": 1e-13})
        worst = float(np.abs(unbalance(found.x)).max())
        if not worst < 1e-9:
            raise DiffsimError(
                f"channel network: mass is lost by {worst:.1e} of the pump's flow {pump:g} m3/s "
                "at the best pressures found; is an effect beyond reason?"
            )
        _, one, two, three = flows(found.x)
        pressure = self._inlet_pressure(pump, float(found.x[0]))
        return np.array([one, two, three, pressure, found.x[0]]), found.x

    def _inlet_pressure(self, pump: float, junction: float) -> float:
        if pump == 0.0:
            return junction
        reach = 100.0 * abs(pump) / self._conductance(0)
        return float(
            brentq(
                lambda p: self.flow(0, p, junction) - pump,
                junction - reach,
                junction + reach,
                xtol=1e-12 * reach,
                rtol=1e-14,
            )
        )

    def _conductance(self, c: int) -> float:
        """Of a Newtonian fluid between rigid walls [m^3/(s Pa)]."""
        newton = self.width[c] ** 3 / (12.0 * self.viscosity[c] * LENGTH_M[c])
        return float(DEPTH_M * newton * self.slip[c] * self.open[c])

    def flow(self, c: int, start: float, end: float) -> float:
        """Flow through a channel from one end's pressure to the other's [m^3/s]."""
        if c == 4 and self.cracking:
            start = end + np.sign(start - end) * max(abs(start - end) - self.cracking, 0.0)
        if self.loss and c >= 2:
            return self._with_loss(c, start - end)
        return self._viscous(c, start, end)

    def _viscous(self, c: int, start: float, end: float) -> float:
        if self.compliance:
            # dp/dx ~ 1 / (1 + k p)^3, integrated along the channel
            a, b = (1.0 + self.compliance * start) ** 4, (1.0 + self.compliance * end) ** 4
            return self._conductance(c) * (a - b) / (4.0 * self.compliance)
        if self.exponent != 1.0:
            return self._power_law(c, start - end)
        return self._conductance(c) * (start - end)

    def _power_law(self, c: int, drop: float) -> float:
        """Slit flow of stress = K rate^n, K such that 100 / s sees the stated viscosity."""
        n, w = self.exponent, self.width[c]
        consistency = self.viscosity[c] * SHEAR_REFERENCE_1_S ** (1.0 - n)
        stress = 0.5 * w * abs(drop) / LENGTH_M[c]
        plane = w * w / (2.0 * (1.0 / n + 2.0)) * (stress / consistency) ** (1.0 / n)
        return float(np.sign(drop) * DEPTH_M * plane * self.slip[c] * self.open[c])

    def _with_loss(self, c: int, drop: float) -> float:
        """Viscous drop plus size rho u^2 / 2: a quadratic equation for the flow."""
        g = self._conductance(c)
        k = 0.5 * self.loss * DENSITY_KG_M3 / (self.width[c] * DEPTH_M) ** 2
        size = 2.0 * abs(drop) / (1.0 / g + np.sqrt(1.0 / g**2 + 4.0 * k * abs(drop)))
        return float(np.sign(drop) * size)


def _plan(name: str, group: str, use: str, t: Array, pump: Array, back: Array) -> Plan:
    return Plan(name, group, use, t, {"pump_m3_s": pump, "outlet_1_Pa": back})
