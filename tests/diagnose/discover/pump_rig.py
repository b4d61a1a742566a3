"""Two pumps and a junction, by Ohm's law alone: recordings with something hidden."""

import numpy as np

from diffsim.data.study import Channel, Column, Run, Study

NOISE = 2.0  # [Pa]
A, B, C = 1e11, 1.5e11, 2e11  # resistances [Pa s/m^3]
DAYS = (291.0, 303.0, 296.0, 299.0, 288.0, 305.0, 293.0, 301.0)  # [K]
STEP = 0.5  # [s]
OFFSET = "sensor_offset_of_pressure"
MODEL = {
    "system": "flow_network",
    "viscosity": {"value": 2e-3, "percent": 1},
    "samples": "time",
    "channels": [
        {"name": "a", "from": "left", "to": "middle", "resistance": A},
        {"name": "b", "from": "right", "to": "middle", "resistance": B},
        {"name": "c", "from": "middle", "to": "out", "resistance": {"value": C, "percent": 3}},
    ],
    "sources": [
        {"node": "left", "flow": "pump_a"},
        {"node": "right", "flow": "pump_b"},
        {"node": "out", "pressure": 0},
    ],
    "meters": [
        {"channel": "p_a", "pressure_at": "left"},
        {"channel": "p_b", "pressure_at": "right"},
    ],
    "nuisances": {"pump_gain": 0, "flow_gain": 0, "pressure_zero": 0},
    "effects": {
        "only": [
            "viscosity",
            "leak",
            "sensor_offset_of_pressure",
            "lag",
            "gain_slope",
            "pump_gain_1",
        ]
    },
    "effort": {"max_effects": 1, "num_refits": 2, "max_rounds": 2},
}


def heated(u, lasts):
    """What warms with a power and cools within a time, in small steps."""
    out, fine = np.zeros(len(u)), 40
    at = np.linspace(0.0, len(u) - 1.0, (len(u) - 1) * fine + 1)
    power = np.interp(at, np.arange(len(u)), u)
    warm = 0.0
    for k in range(1, len(at)):
        middle = 0.5 * (power[k] + power[k - 1])
        warm += STEP / fine / lasts * (middle - warm)
        if k % fine == 0:
            out[k // fine] = warm
    return out


def recorded(
    pump=lambda flow: flow,
    stiffen=lambda day: 1.0,
    show=lambda p_a, p_b, temperature: p_a,
    uses=("fit",) * 5 + ("select", "test"),
    count=40,
    seed=0,
):
    """A study of the rig.

    Args:
        pump: What the first pump gives, of what it is asked for.
        stiffen: Factor on the resistance of c, of the temperature of the day.
        show: What the first meter shows.
        uses: Use of each run.
        count: Samples of each.
        seed: Of commands and noise.
    """
    rng = np.random.default_rng(seed)
    runs = []
    for k, use in enumerate(uses):
        time = STEP * np.arange(count)
        ask_a, ask_b = (
            1e-9 * np.clip(2.0 + 0.4 * np.cumsum(rng.standard_normal(count)), 0.3, 5.0)
            for _ in range(2)
        )
        temperature = 298.0 + 8.0 * np.sin(0.11 * (1.0 + 0.2 * k) * time + k)
        flow, c = pump(ask_a), C * stiffen(DAYS[k])
        p_a, p_b = A * flow + c * (flow + ask_b), B * ask_b + c * (flow + ask_b)
        clean = np.stack([show(p_a, p_b, temperature), p_b], 1)
        runs.append(
            Run(
                f"run_{k}",
                time,
                clean + NOISE * rng.standard_normal(clean.shape),
                {"pump_a": ask_a, "pump_b": ask_b},
                f"g{k}",
                k,
                use,
                {"day_temperature": DAYS[k]},
                {"temperature": temperature},
            )
        )
    channels = tuple(Channel(n, "Pa", "pressure", NOISE) for n in ("p_a", "p_b"))
    columns = (Column("temperature", "K", "temperature [degC]"),)
    return Study("rig", "flow_network", channels, tuple(runs), model=MODEL, columns=columns)
