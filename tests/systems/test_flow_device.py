"""The flow device: effects vanish at size 0, scores are exact, each acts as its physics says."""

import time
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import brentq

from diffsim.core.errors import ConvergenceError
from diffsim.data.study import Channel, Run, Study
from diffsim.identify import Effect, Numerics, SimModel
from diffsim.systems.flow_network import ChannelDevice, Opening
from diffsim.systems.registry import description_of, setup_of

DEVICES = {
    "pumps": ChannelDevice(),
    "two_pumps": ChannelDevice(inlets=(Opening(2.747e-3, 1.441e-3), Opening(6.317e-3, 1.683e-3))),
    "regulator": ChannelDevice(drive="pressure", nominal_drive=100.0),
}
BRANCH = Opening(4.527e-3, 1.629e-3)
SINGLE = ChannelDevice(outlets=(BRANCH,))
ROUNDING = 1e-9  # of a solve, relative: by the condition number, and by the order of its sums


def commands_of(device: ChannelDevice) -> tuple[str, ...]:
    """One of each inlet."""
    unit = "m2_s" if device.drive == "flow" else "Pa"
    return tuple(f"{device.drive}_in_{i + 1}_{unit}" for i in range(len(device.inlets)))


def channels_of(device: ChannelDevice) -> tuple[Channel, ...]:
    """Flows, pressures at the inlets, a profile across the last outlet."""
    rows = (
        ("flow_out", len(device.outlets), "m^2/s", "flow", 1e-7),
        ("pressure", len(device.inlets), "Pa", "pressure", 0.5),
        ("speed", device.num_profile_points, "m/s", "velocity", 1e-4),
    )
    return tuple(
        Channel(f"{name}_{i + 1}", unit, kind, sd)
        for name, count, unit, kind, sd in rows
        for i in range(count)
    )


def described(device: ChannelDevice, **keys) -> dict:
    """Viscosity to 2 %, walls to 0.3 % of the narrowest channel, gains to 0.5 %."""
    names = [c.name for c in channels_of(device)]
    flows, taps = len(device.outlets), len(device.inlets)
    narrowest = min(o.width for o in (*device.inlets, *device.outlets))
    return {
        "system": "flow_device",
        "manifold": {
            key: [vars(o) for o in value] if key in ("inlets", "outlets") else value
            for key, value in vars(device).items()
            if key not in ("viscosity", "num_profile_points")
        },
        "viscosity": {"value": device.viscosity, "percent": 2},
        "wall_offset": {"value": 0.0, "sd": 0.0015 * narrowest},
        "drives": list(commands_of(device)),
        "flows": names[:flows],
        "pressures": names[flows : flows + taps],
        "velocities": names[flows + taps :],
        **keys,
    }


def study_of(device: ChannelDevice, keys=None, **changes) -> Study:
    settings = {"channels": channels_of(device), "runs": (run_of(device, [0.5, 1.0]),), **changes}
    return Study(
        name="s", system="flow_device", model=described(device, **(keys or {})), **settings
    )


def device_model(device: ChannelDevice, **keys) -> SimModel:
    study = study_of(device, keys)
    return description_of(study).model(study)


@lru_cache
def causes_of(device: ChannelDevice) -> tuple[Effect, ...]:
    return setup_of(study_of(device)).effects


def run_of(device: ChannelDevice, levels: list[float], repeats: int = 2) -> Run:
    """Drive levels in units of the nominal one, each held for some samples."""
    command = np.repeat(np.asarray(levels) * device.nominal_drive, repeats)
    names = commands_of(device)
    shares = 1.0 + 0.3 * np.arange(len(names))
    return Run(
        name="levels",
        time_s=np.arange(len(command), dtype=float),
        measured=np.zeros((len(command), len(channels_of(device)))),
        command={n: s * command for n, s in zip(names, shares, strict=True)},
        group="levels",
    )


def predict(model: SimModel, run: Run, effect: Effect | None = None, size=0.0, mesh: float = 1.0):
    sizes = None if effect is None else {effect: torch.tensor([size], dtype=torch.float64)}
    with torch.no_grad():
        return model.predict(run, model.at_prior(), sizes, Numerics(mesh=mesh)).numpy()


def effect_of(device: ChannelDevice, name: str) -> Effect:
    return {e.name: e for e in causes_of(device)}[name]


def change(device: ChannelDevice, name: str, size: float, levels: list[float], mesh: float = 1.0):
    """Relative change of all channels by an effect, (num_levels, num_channels)."""
    model, run = device_model(device), run_of(device, levels, repeats=1)
    effect = effect_of(device, name)
    return predict(model, run, effect, size, mesh) / predict(model, run, mesh=mesh) - 1.0


@pytest.mark.grad
@pytest.mark.parametrize("effect", causes_of(DEVICES["regulator"]), ids=lambda e: e.name)
def test_scores_against_differences(effect):
    """Of a pump they are those of the contract of every kind."""
    device = DEVICES["regulator"]
    if effect.name in ("leak_per_depth", "skewed_inlet"):
        assert effect.needs(study_of(device)) is not None  # no response at all
        return
    model, run = device_model(device), run_of(device, [0.7], repeats=1)
    plain = predict(model, run)
    weights = torch.linspace(1.0, 2.0, plain.size, dtype=torch.float64).view(plain.shape)
    weights /= torch.from_numpy(plain).abs().amax(0)

    leaf = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    (adjoint,) = torch.autograd.grad(
        (weights * model.predict(run, model.at_prior(), {effect: leaf})).sum(), leaf
    )
    assert abs(adjoint.item()) > 0.0
    # Most sizes cannot be negative. At most 0.03 um of wall, which passes no node; a pressure that
    # fades in at a corner bends within that, hence the order of four.
    h = 2e-4 * effect.typical
    at = np.array([predict(model, run, effect, k * h) for k in range(5)])
    slopes = weights.numpy() * np.tensordot([-25.0, 48.0, -36.0, 16.0, -3.0], at, 1) / (12.0 * h)
    # Channels may cancel: with a compliant wall their sum is a fortieth of what they move.
    np.testing.assert_allclose(adjoint.item(), slopes.sum(), atol=2e-4 * np.abs(slopes).sum())


def test_outlets_sum_to_the_pump_on_both_grids():
    device = DEVICES["two_pumps"]
    model, run = device_model(device), run_of(device, [1.0], repeats=1)
    given = sum(c[0] for c in run.command.values())
    lost = []
    for mesh in (1.0, 0.5):
        with torch.no_grad():
            out = model.predict(run, model.at_prior(), None, Numerics(mesh=mesh))[0]
        lost.append(abs(float(out[:3].sum()) / given - 1.0))
    assert lost[0] < 6e-3 and lost[1] < 2e-3  # through walls at the corners: second order


def test_branch_profile_is_a_parabola():
    out = predict(device_model(SINGLE), run_of(SINGLE, [1.0], 1), mesh=0.5)[0]
    y = SINGLE.profile_points[:, 1] - BRANCH.y
    parabola = 1.5 * out[0] / BRANCH.width * (1.0 - (2.0 * y / BRANCH.width) ** 2)
    np.testing.assert_allclose(out[2:], parabola, rtol=6e-3)  # 26 cells across, linear in each


def profile_ratio(name: str, size: float, of_width) -> None:
    """Profile with an effect over that without, against a closed form u(y, width, flow)."""
    measured = change(SINGLE, name, size, [1.0], mesh=0.5)[0, 2:] + 1.0
    y = SINGLE.profile_points[:, 1] - BRANCH.y
    plain = 1.5 / BRANCH.width * (1.0 - (2.0 * y / BRANCH.width) ** 2)
    np.testing.assert_allclose(measured, of_width(y) / plain, rtol=8e-3)


def test_slip_profile():
    b, w = 8e-5, BRANCH.width
    profile_ratio("slip", b, lambda y: (w**2 / 4 - y**2 + b * w) / (w**3 / 6 * (1 + 6 * b / w)))


def test_wall_offset_profile():
    w = BRANCH.width + 2.0 * 6e-5
    profile_ratio("wall_offset", 6e-5, lambda y: 1.5 / w * (1.0 - (2.0 * y / w) ** 2))


def test_compliance_widens_with_the_pressure_there():
    c = 3e-4
    x = SINGLE.profile_points[0, 0]
    out = predict(device_model(SINGLE), run_of(SINGLE, [1.0], 1))[0]
    drop = 12.0 * SINGLE.viscosity * out[0] / BRANCH.width**3 * (SINGLE.size[0] - x)
    w = BRANCH.width * (1.0 + c * drop)
    assert w / BRANCH.width > 1.01
    profile_ratio("compliance", c, lambda y: 1.5 / w * (1.0 - (2.0 * y / w) ** 2))


def test_temperature_gradient_leans_the_profile():
    """Poiseuille flow with viscosity linear in y, by quadrature."""
    g, w, height = 0.8, BRANCH.width, SINGLE.size[1]

    def eta(y):
        return 1.0 + g * ((y + BRANCH.y) / height - 0.5)

    def integral(f, to):
        return quad(f, -w / 2, to)[0]

    middle = integral(lambda s: s / eta(s), w / 2) / integral(lambda s: 1.0 / eta(s), w / 2)

    def u(y):
        return -integral(lambda s: (s - middle) / eta(s), y)

    flow = quad(u, -w / 2, w / 2)[0]
    profile_ratio("temperature_gradient", g, lambda y: np.array([u(v) for v in y]) / flow)


def test_thinning_blunts_the_profile():
    """Poiseuille flow of the shear-thinning fluid, by root finding and quadrature."""
    n, w, rate0 = 0.3, BRANCH.width, SINGLE.shear_rate

    def rate(stress):  # rate (1 + (rate / rate0)^2)^(-n / 2) = stress, viscosity 1
        def excess(r):
            return r * (1.0 + (r / rate0) ** 2) ** (-n / 2) - stress

        return brentq(excess, 0.0, 10.0 * stress + 1e-9)

    def u(y, slope):
        return quad(lambda s: rate(slope * s), abs(y), w / 2)[0]

    def flow(slope):
        return 2.0 * quad(lambda y: u(y, slope), 0.0, w / 2, epsrel=1e-6)[0]

    target = 1e-4  # nominal flow
    slope = brentq(lambda k: flow(k) - target, 0.2 * 12e-4 / w**3, 1.2 * 12e-4 / w**3, rtol=1e-6)
    profile_ratio("thinning", n, lambda y: np.array([u(v, slope) for v in y]) / target)


def test_inertia_grows_with_the_drive_and_turns_with_it():
    shares = change(DEVICES["pumps"], "fluid_inertia", 300.0, [-0.1, 0.1, 0.2])[:, :3]
    np.testing.assert_allclose(shares[2], 2.0 * shares[1], rtol=0.03)  # next order
    np.testing.assert_allclose(shares[0], -shares[1], rtol=0.03)
    assert np.abs(shares[1]).max() > 1e-4


def test_inertia_leaves_a_developed_profile():
    moved = change(SINGLE, "fluid_inertia", 1000.0, [1.0])[0]
    assert np.abs(moved[2:]).max() < 1e-3 < 2e-3 < abs(moved[1])  # the tap sees the widening


def test_leak_follows_the_pressure():
    k, device = 3e-8, DEVICES["pumps"]
    model, run = device_model(device), run_of(device, [1.0, 2.0], 1)
    plain, leaking = (
        predict(model, run),
        predict(model, run, effect_of(device, "leak_per_depth"), k),
    )
    lost = (plain - leaking)[:, :3].sum(1) / (plain[:, :3].sum(1) / run.command["flow_in_1_m2_s"])
    np.testing.assert_allclose(lost, k * leaking[:, 3], rtol=1e-5)


def test_regulators_hold_pressure_while_viscosity_slows_the_flow():
    slower = change(DEVICES["regulator"], "viscosity", 0.25, [1.0])[0]
    np.testing.assert_allclose(slower[:3], -0.2, rtol=1e-6)
    np.testing.assert_allclose(slower[3], 0.0, atol=1e-8)
    pumped = change(DEVICES["pumps"], "viscosity", 0.25, [1.0])[0]
    np.testing.assert_allclose(pumped[[0, 1, 2, 3]], [0.0, 0.0, 0.0, 0.25], atol=1e-7)


def test_gains_act_on_what_they_name():
    pump = change(DEVICES["pumps"], "pump_gain_1", 0.1, [0.5, 1.0])
    # the quotient of two solves: the pressure is off by 2e-11 with AVX-512, 1e-10 with SSE2
    np.testing.assert_allclose(pump, 0.1, rtol=0.0, atol=ROUNDING)
    meter = change(DEVICES["pumps"], "meter_gain_2", 0.1, [1.0])[0]
    np.testing.assert_allclose(meter[1], 0.1, rtol=1e-9)
    assert np.abs(np.delete(meter, 1)).max() == 0.0


def test_blocked_branch_is_constant_and_offset_fades_with_the_drive():
    blocked = change(DEVICES["pumps"], "blocked_branch_1", 0.2, [0.5, 2.0])
    np.testing.assert_allclose(blocked[0], blocked[1], rtol=1e-6)
    assert blocked[0, 0] < -0.1 and (blocked[0, 1:3] > 0.02).all()
    offset = change(DEVICES["pumps"], "pressure_offset_1", 5.0, [0.5, 2.0])
    np.testing.assert_allclose(offset[0], 4.0 * offset[1], rtol=1e-6)
    assert offset[0, 0] < -0.01


def test_skewed_inlet_keeps_the_flow_and_moves_the_split():
    moved = change(DEVICES["pumps"], "skewed_inlet", 1.0, [1.0])[0]
    assert abs(moved[0]) > 1e-3 and moved[0] * moved[2] < 0.0
    weights = predict(device_model(DEVICES["pumps"]), run_of(DEVICES["pumps"], [1.0], 1))[0, :3]
    assert abs((moved[:3] * weights).sum() / weights.sum()) < 1e-5


def test_slip_and_wall_offset_are_nearly_the_same():
    """To first order a wall with slip b is a wall b further out: an honest confounding."""
    slip = change(DEVICES["pumps"], "slip", 4e-6, [1.0])[0]
    offset = change(DEVICES["pumps"], "wall_offset", 4e-6, [1.0])[0]
    assert slip @ offset / np.linalg.norm(slip) / np.linalg.norm(offset) > 0.99


def test_needs():
    device = DEVICES["pumps"]
    no_pressure = tuple(c for c in channels_of(device) if c.kind != "pressure")
    run = run_of(device, [1.0])
    run = replace(run, measured=run.measured[:, : len(no_pressure)])
    blind = study_of(device, channels=no_pressure, runs=(run,))
    unmet = {e.name: e.needs(blind) for e in causes_of(device)}
    assert unmet["viscosity"] == "a pressure channel"
    assert unmet["compliance"] == "two drive levels or more"
    assert unmet["slip"] is None
    assert all(e.needs(study_of(device)) is None for e in causes_of(device))
    regulated = study_of(DEVICES["regulator"])
    assert "driven by flow" in (effect_of(device, "leak_per_depth").needs(regulated) or "")


def test_mistakes_are_named():
    device = DEVICES["pumps"]
    with pytest.raises(ValueError, match="drive must be one of"):
        ChannelDevice(drive="flows")
    with pytest.raises(ValueError, match=r"outlets must be ordered .* refine cells"):
        ChannelDevice(outlets=(Opening(3e-3, 1.4e-3), Opening(4.5e-3, 1.4e-3)))
    other = run_of(DEVICES["regulator"], [1.0])
    with pytest.raises(ValueError, match="run levels has no command 'flow_in_1_m2_s'"):
        setup_of(study_of(device, runs=(other,)))
    with pytest.raises(ValueError, match="run levels: command must be one of"):
        predict(device_model(device), other)
    with pytest.raises(ConvergenceError, match=r"too large to be swept \(sizes: slip_length 0.002"):
        predict(device_model(device), run_of(device, [1.0]), effect_of(device, "slip"), 2e-3)


def test_what_is_known_is_no_base_parameter():
    known = {"wall_offset": 0.0, "nuisances": {"pump_gain": 0, "flow_gain": 0}}
    model, run = device_model(SINGLE, **known), run_of(SINGLE, [1.0])
    assert [p.name for p in model.base] == ["viscosity"]
    np.testing.assert_allclose(predict(model, run), predict(device_model(SINGLE), run))
    wider = device_model(SINGLE, **{**known, "wall_offset": 2e-5})
    there = predict(device_model(SINGLE), run, effect_of(SINGLE, "wall_offset"), 2e-5)
    np.testing.assert_allclose(predict(wider, run), there)


def test_a_prediction_is_fast():
    """Factorization once, then one solve whatever the number of samples."""
    device = DEVICES["pumps"]
    model, run = device_model(device), run_of(device, [0.25, 0.5, 1.0, 2.0], repeats=50)
    predict(model, run)
    start = time.process_time()
    for _ in range(5):
        predict(model, run, effect_of(device, "pump_gain_1"), 0.01)
    assert (time.process_time() - start) / 5 < 0.1
