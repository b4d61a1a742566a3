"""The closed form of a reading on a thrust stand, against hand calculations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from diffsim.data.importers.common import physical, scaled
from diffsim.data.importers.rotor_bench import SCATTER
from diffsim.data.study import Run
from diffsim.systems.bench.effects import BENCH, CURRENT_LIMIT, THRUST_EXPONENT
from diffsim.systems.bench.model import bench_model

SIGNAL = np.array([1200.0, 1500.0, 1800.0, 2000.0])
SPEED = np.array([250.0, 580.0, 750.0, 880.0])


def sweep(name="kde2814_10in_up", diameter=0.254, voltage=11.1):
    n = len(SIGNAL)
    command = {
        "esc_signal_us": SIGNAL,
        "speed_rad_s": SPEED,
        "thrust_N": 9e-6 * SPEED**2,
        "current_A": np.linspace(0.4, 8.0, n),
        "voltage_V": np.full(n, voltage - 0.3),
        "reading": np.arange(float(n)),
    }
    setup = {"propeller_diameter_m": diameter, "supply_nominal_V": voltage}
    return Run(name, 0.1 * np.arange(n), np.zeros((n, 4)), command, name, setup=setup)


def predicted(run, sizes=None):
    model = bench_model((run,))
    values = {p.name.split(".")[1]: p.value for p in model.base}
    out = model.predict(run, model.at_prior(), sizes).numpy()
    return values, [physical(c, *SCATTER[k]) for c, k in zip(out.T, SCATTER, strict=True)]


def test_plain_reading():
    v, (thrust, torque, speed, current) = predicted(sweep())
    run_thrust = sweep().command["thrust_N"]
    np.testing.assert_allclose(thrust, v["thrust_coefficient"] * SPEED**2)
    np.testing.assert_allclose(torque, v["torque_ratio"] * thrust)
    power = v["power_coefficient"] * run_thrust**1.5
    np.testing.assert_allclose(current, power / 11.1 + v["current_offset"])
    for signal, found in zip(SIGNAL, speed, strict=True):
        u = 11.1 * ((signal - 1000.0) / 1000.0) ** v["throttle_exponent"]
        # u = w / K + load: at w = K u the load would take the share L u
        k, load = v["speed_constant"], v["load_slope"]
        root = brentq(lambda w, u=u, k=k, load=load: w / k + load * (w / k) ** 2 - u, 0.0, 2e3)
        assert found == pytest.approx(root)


def test_scaled_readings_have_unit_scatter_and_come_back():
    x = np.array([0.0, 0.003, 0.1, 5.0])
    floor, share = SCATTER["thrust_N"]
    np.testing.assert_allclose(physical(scaled(x, floor, share), floor, share), x, atol=1e-12)
    step = 1e-6
    slope = (scaled(x + step, floor, share) - scaled(x - step, floor, share)) / (2 * step)
    np.testing.assert_allclose(slope, 1.0 / np.hypot(floor, share * x), rtol=1e-6)


def test_thrust_exponent_is_one():
    size = torch.tensor([0.12, 0, 0, 0, 0, 0], dtype=torch.float64)
    _, plain = predicted(sweep())
    _, changed = predicted(sweep(), {THRUST_EXPONENT: size})
    slope = np.polyfit(np.log(SPEED), np.log(changed[0] / plain[0]), 1)[0]
    assert slope == pytest.approx(0.12)
    np.testing.assert_allclose(changed[1] / plain[1], changed[0] / plain[0])  # torque follows


def test_current_limit_limits_current_and_speed():
    run = sweep("a1_11", 0.127)
    _, plain = predicted(run)
    limit = 0.5 * plain[3].max()
    _, limited = predicted(run, {CURRENT_LIMIT: torch.tensor([1.0 / limit]).double()})
    assert limited[3].max() == pytest.approx(limit)
    assert limited[2].max() <= plain[2].max()


def test_effects_are_nothing_at_zero():
    for run in (sweep(), sweep("a1_11", 0.127)):
        _, plain = predicted(run)
        for effect in BENCH:
            size = torch.zeros(len(effect.components), dtype=torch.float64)
            _, same = predicted(run, {effect: size})
            np.testing.assert_allclose(same, plain, rtol=1e-12)
