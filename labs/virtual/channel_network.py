"""Virtual laboratory of a flow distributor: one pump, three outlets, a plane network of channels.

Lubrication theory: every channel is a slit, flow ~ width^3 dp / (12 viscosity length) with the
exact corrections for slip, shear-thinning fluids and compliant walls; pressures at the pump and the
two junctions from conservation of mass (root finding with scipy). No grid, no level set: it shares
nothing with the Stokes solver.

::

    pump ==inlet== J1 ==link== J2 ==branch 2== outlet 2 (at atmosphere)
                   ||          ``==branch 3== outlet 3 (at atmosphere)
                   ``==branch 1== outlet 1 (at a commanded back pressure)

Every sample is a steady state at one level of the pump. Junctions enter by the hydraulic lengths of
the channels that meet there, which a network cannot know: they were taken once from a Stokes flow
on a fine grid. Not modeled: what junctions do beyond that, start-up of the flow.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, root

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Channel
from labs.virtual.common import GAIN_JITTER, Base, Lab, LabEffect, Plan, size_of, vector_of

Array = NDArray[np.float64]

DEPTH_M = 1e-3  # out of the plane; flows are plane flows times this
CHANNELS = ("inlet", "link", "branch_1", "branch_2", "branch_3")
ENDS = (("pump", "J1"), ("J1", "J2"), ("J1", "outlet_1"), ("J2", "outlet_2"), ("J2", "outlet_3"))
WIDTH_M = np.array([600e-6, 500e-6, 360e-6, 340e-6, 400e-6])
POSITION_M = {
    "pump": (0.7e-3, 4.35e-3),
    "J1": (3.4e-3, 3.3e-3),
    "J2": (6.0e-3, 4.6e-3),
    "outlet_1": (10.0e-3, 0.9e-3),
    "outlet_2": (10.0e-3, 3.5e-3),
    "outlet_3": (10.0e-3, 6.2e-3),
}
BOX_M = (10.0e-3, 7.2e-3)
LENGTH_M = np.array([3.040e-3, 2.897e-3, 6.678e-3, 3.766e-3, 3.939e-3])  # hydraulic
TAP = 0.7  # place of the second pressure sensor on the way from the pump to J1
TAP_M = 2.028e-3  # the same as hydraulic length
DENSITY_KG_M3 = 1100.0
SHEAR_REFERENCE_1_S = 100.0  # at which thinning sets in
BLOCKAGE = 0.5  # share of a branch's length, in its middle, that a blockage narrows
CRACKING_PA = 40.0
_SENSORS = (
    *((f"outlet_{i}_m3_s", "m3/s", "flow", 1e-10) for i in (1, 2, 3)),
    ("pump_Pa", "Pa", "pressure", 0.5),
    ("tap_Pa", "Pa", "pressure", 0.5),
)


class NetworkLab(Lab):
    """See the module; channels are the flows at the outlets, pump and tap pressure."""

    system: ClassVar[str] = "stokes"
    channels: ClassVar[tuple[Channel, ...]] = tuple(Channel(*s) for s in _SENSORS)
    base: ClassVar[dict[str, Base]] = {
        "viscosity": Base(5.0e-3, 0.01, "Pa s"),
        **{
            f"width_{n}": Base(float(w), 0.003, "m") for n, w in zip(CHANNELS, WIDTH_M, strict=True)
        },
    }
    effects: ClassVar[dict[str, LabEffect]] = {
        "slip": LabEffect("m", 3e-6, "slip length: flow times 1 + 6 size / width"),
        "wall_offset": LabEffect("m", 4e-6, "every wall moved outwards: width + 2 size"),
        "viscosity": LabEffect("-", 0.1, "viscosity times 1 + size"),
        "temperature_gradient": LabEffect(
            "-", 0.2, "viscosity rises by size of its value from the box's lower to its upper side"
        ),
        "compliance": LabEffect("1/Pa", 5e-4, "width times 1 + size pressure"),
        "thinning": LabEffect(
            "-", 0.1, "viscosity (1 + (rate / 100 1/s)^2)^(-size / 2): power law at high rates"
        ),
        "entrance_loss": LabEffect("-", 3.0, "loss of size rho u^2 / 2 at each branch's entrance"),
        "leak": LabEffect("m3/(s Pa)", 1e-11, "to atmosphere, at the pump's fitting"),
        "pump_gain": LabEffect("-", 0.03, "the pump gives 1 + size times the set flow"),
        "meter_gain": LabEffect("-", 0.03, "the meters read 1 + size times the flow", 3),
        "blocked_branch": LabEffect(
            "-", 0.1, "middle half of a branch narrower by up to size of its width", 3
        ),
        "pressure_offset": LabEffect("Pa", 5.0, "back pressure at one outlet", 3),
        "pressure_scale": LabEffect("-", 0.03, "pressure sensors read 1 + size times"),
        "cracking": LabEffect("-", 1.0, "branch 3 opens above 40 Pa only", outside=True),
    }

    def plans(self, rng: np.random.Generator) -> list[Plan]:
        t: Array = np.arange(60, dtype=np.float64)
        level = 2e-8
        ones = np.ones(60)
        commands: dict[str, tuple[Array, Array]] = {
            "low": (_held(level, 0.05, 0.3, 0.15, 0.4, 0.1, 0.2), 0.0 * ones),
            "staircase": (_held(level, 0.3, 0.6, 0.9, 1.2, 1.6, 2.0), 0.0 * ones),
            "back_pressure": (level * ones, _held(8.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)),
        }
        plans = []
        for repeat in "ab":
            for name, (pump, back) in commands.items():
                plans.append(_plan(f"{name}_{repeat}", name, "fit", t, pump, back))
        unseen = _held(level, 0.5, 1.8, 1.1, 0.25, 1.4, 0.7)
        raised = np.where(t >= 30.0, 25.0, 0.0)
        return [*plans, _plan("mixed", "mixed", "test", t, unseen, raised)]

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
        guess = np.zeros(3)
        for i, (flow, back) in enumerate(zip(pump, plan.command["outlet_1_Pa"], strict=True)):
            out[i], guess = network.steady(float(flow), float(back), guess)
        out[:, :3] *= 1.0 + truth["nuisances"]["meter_gain"] + vector_of(truth, "meter_gain", 3)
        out[:, 3:] *= 1.0 + size_of(truth, "pressure_scale")
        out[:, 3:] += truth["nuisances"]["pressure_zero_Pa"]
        return out, dict(plan.command)

    def facts(self) -> dict[str, Any]:
        return {
            "geometry": {
                "position_m": {name: list(at) for name, at in POSITION_M.items()},
                "channels": {
                    name: {"start": a, "end": b, "width_m": float(w)}
                    for name, (a, b), w in zip(CHANNELS, ENDS, WIDTH_M, strict=True)
                },
                "box_m": list(BOX_M),
                "depth_m": DEPTH_M,
                "depth_meaning": "flows are plane flows (m2/s) times the depth",
                "ends": "the inlet goes on straight to the box's left side; outlets lie on its "
                "right side",
                "pump_Pa": "at the position pump",
                "tap_Pa": "on the inlet's axis",
                "tap_share": TAP,
                "blockage_share": BLOCKAGE,
                "blockage_meaning": "a blockage is a raised cosine over this share of a branch",
            },
            "density_kg_m3": DENSITY_KG_M3,
            "thinning_rate_1_s": SHEAR_REFERENCE_1_S,
            "time": "every sample is a steady state; time_s counts them",
            "nuisances": {
                "pump_gain_sd": GAIN_JITTER,
                "meter_gain_sd": 0.005,
                "pressure_zero_sd_Pa": 0.2,
            },
        }


class _Network:
    """Flows of the true network."""

    def __init__(self, truth: dict[str, Any]):
        base, self.truth = truth["base"], truth
        offset = 2.0 * size_of(truth, "wall_offset")
        self.width = np.array([base[f"width_{name}"] for name in CHANNELS]) + offset
        height = np.array([0.5 * (POSITION_M[a][1] + POSITION_M[b][1]) for a, b in ENDS])
        warmth = size_of(truth, "temperature_gradient") * (height / BOX_M[1] - 0.5)
        self.viscosity = base["viscosity"] * (1.0 + size_of(truth, "viscosity")) * (1.0 + warmth)
        self.slip = 1.0 + 6.0 * size_of(truth, "slip") / self.width
        shares = np.concatenate([[0.0, 0.0], vector_of(truth, "blocked_branch", 3)])
        self.open = np.array([_openness(float(share)) for share in shares])
        self.back = vector_of(truth, "pressure_offset", 3)
        self.thinning = size_of(truth, "thinning")
        self.compliance = size_of(truth, "compliance")
        self.loss = size_of(truth, "entrance_loss")
        self.leak = size_of(truth, "leak")
        self.cracking = CRACKING_PA * size_of(truth, "cracking")

    def steady(self, pump: float, outlet_1: float, guess: Array) -> tuple[Array, Array]:
        """Outlet flows [m^3/s], pump and tap pressure [Pa]; and pressures of pump, J1, J2."""
        scale = max(abs(pump), 1e-10)
        back = self.back + np.array([outlet_1, 0.0, 0.0])

        def flows(p: Array) -> Array:
            return np.array(
                [
                    self.flow(0, p[0], p[1]),
                    self.flow(1, p[1], p[2]),
                    self.flow(2, p[1], back[0]),
                    self.flow(3, p[2], back[1]),
                    self.flow(4, p[2], back[2]),
                ]
            )

        def unbalance(p: Array) -> Array:
            inlet, link, one, two, three = flows(p)
            at_pump = pump - self.leak * p[0] - inlet
            return np.array([at_pump, inlet - link - one, link - two - three]) / scale

        solution = root(unbalance, guess, method="hybr", options={"xtol": 1e-13})
        worst = float(np.abs(unbalance(solution.x)).max())
        if not worst < 1e-9:
            raise DiffsimError(
                f"channel network: mass is lost by {worst:.1e} of the pump's flow {pump:g} m3/s "
                "at the best pressures found; is an effect beyond reason?"
            )
        out = flows(solution.x)[2:]
        return np.array([*out, solution.x[0], self._tap(*solution.x[:2])]), solution.x

    def _tap(self, start: float, end: float) -> float:
        """Pressure at the tap between the inlet channel's ends."""
        share, c = TAP_M / LENGTH_M[0], self.compliance
        if not c:
            return float(start + share * (end - start))
        a, b = (1.0 + c * start) ** 4, (1.0 + c * end) ** 4
        return float(((a + share * (b - a)) ** 0.25 - 1.0) / c)

    def _conductance(self, c: int) -> float:
        """Conductance of channels for a Newtonian fluid between rigid walls [m^3/(s Pa)]."""
        newton = self.width[c] ** 3 / (12.0 * self.viscosity[c] * LENGTH_M[c])
        return float(DEPTH_M * newton * self.slip[c] * self.open[c])

    def flow(self, c: int, start: float, end: float) -> float:
        """Flow through a channel from one end's pressure to the other's [m^3/s]."""
        if c == 4 and self.cracking:
            start = end + np.sign(start - end) * max(abs(start - end) - self.cracking, 0.0)
        if self.loss and c >= 2:
            return self._with_loss(c, start, end)
        return self._viscous(c, start, end)

    def _viscous(self, c: int, start: float, end: float) -> float:
        k = self.compliance
        # dp/dx ~ 1 / (1 + k p)^3, integrated along the channel
        drop = ((1.0 + k * start) ** 4 - (1.0 + k * end) ** 4) / (4.0 * k) if k else start - end
        newton = self._conductance(c) * drop
        return newton * self._faster(c, abs(drop)) if self.thinning else newton

    def _faster(self, c: int, drop: float) -> float:
        """Flow of the thinning fluid over that of the Newtonian one (Rabinowitsch).

        With the wall's stress s, rate g(tau): Q / Q_Newton = 3 eta / s^3 int_0^s tau g(tau) dtau,
        integrated by parts and over the rate, so that no inverse of the flow curve is needed but
        at the wall.
        """
        stress = 0.5 * self.width[c] * drop / LENGTH_M[c] / self.viscosity[c]  # over viscosity
        if stress < 1e-9 * SHEAR_REFERENCE_1_S:
            return 1.0

        def of_rate(g: Any) -> Any:
            return g * (1.0 + (g / SHEAR_REFERENCE_1_S) ** 2) ** (-0.5 * self.thinning)

        top = 2.0 * stress
        while of_rate(top) < stress:
            top *= 2.0
        wall = brentq(lambda g: of_rate(g) - stress, 0.0, top, xtol=1e-12 * top, rtol=1e-14)
        rates = 0.5 * wall * (_GAUSS_X + 1.0)
        inner = 0.5 * wall * float(_GAUSS_W @ of_rate(rates) ** 2)
        return 1.5 * (stress**2 * wall - inner) / stress**3

    def _with_loss(self, c: int, start: float, end: float) -> float:
        """Flow whose viscous drop plus size rho u^2 / 2 make up the drop."""
        k = 0.5 * self.loss * DENSITY_KG_M3 / (self.width[c] * DEPTH_M) ** 2
        if start == end:
            return 0.0

        def excess(q: float) -> float:
            return self._viscous(c, start - k * q * abs(q), end) - q

        most = 1.01 * self._viscous(c, start, end)
        return float(brentq(excess, *sorted((0.0, most)), xtol=1e-22, rtol=1e-14))


_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(24)


def _openness(size: float) -> float:
    """Conductance of a blocked branch over that of the open one: the mean of width^-3 inverted."""
    x = (np.arange(2000) + 0.5) / 2000
    hump = np.where(np.abs(x - 0.5) < 0.5 * BLOCKAGE, np.cos(np.pi * (x - 0.5) / BLOCKAGE) ** 2, 0)
    return float(1.0 / np.mean((1.0 - size * hump) ** -3))


def _held(unit: float, *levels: float) -> Array:
    """Levels in a unit, each held for ten samples."""
    return np.asarray(unit * np.repeat(levels, 10), dtype=np.float64)


def _plan(name: str, group: str, use: str, t: Array, pump: Array, back: Array) -> Plan:
    return Plan(name, group, use, t, {"pump_m3_s": pump, "outlet_1_Pa": back})
