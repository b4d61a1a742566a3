"""Channel networks described in YAML: laws of channels, keys, causes, the laboratory's own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.causes.scales import HELD
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.identify import fit
from diffsim.systems.registry import description_of, setup_of
from labs.systems import network
from labs.virtual import NetworkLab
from labs.virtual import channel_network as lab

ETA = 2e-3
ONE = {
    "system": "flow_network",
    "viscosity": ETA,
    "channels": [
        {
            "name": "a",
            "from": "in",
            "to": "out",
            "width": "0.2 mm",
            "height": "1 mm",
            "length": 0.01,
        }
    ],
    "sources": [{"node": "in", "flow": "pump"}, {"node": "out", "pressure": 0}],
    "meters": [{"channel": "p", "pressure_at": "in"}],
    "nuisances": {"pump_gain": 0, "flow_gain": 0, "pressure_zero": 0},
}


def study(model, names, **commands) -> Study:
    """One run without readings under commands of equal length."""
    count = len(next(iter(commands.values())))
    command = {k: np.asarray(v, dtype=float) for k, v in commands.items()}
    run = Run("r", np.arange(float(count)), np.zeros((count, len(names))), command, "g")
    channels = tuple(Channel(n, "-", "any", 1.0) for n in names)
    return Study("s", "flow_network", channels, (run,), model=model)


def predict(s: Study, **sizes) -> np.ndarray:
    setup = setup_of(s)
    known = {e.name: e for e in setup.effects}
    at = {known[k]: torch.tensor([v], dtype=torch.float64) for k, v in sizes.items()}
    return setup.model.predict(s.runs[0], setup.model.at_prior(), at).detach().numpy()


def single(tube: dict, **keys) -> dict:
    base = {"name": "a", "from": "in", "to": "out"}
    return {**ONE, "channels": [base | tube], **keys}


SHAPES = {
    "slit": (
        {"width": "0.2 mm", "height": "1 mm", "length": 0.01, "is_slit": True},
        12 * ETA * 0.01 / (1e-3 * 2e-4**3),
    ),
    "round": ({"diameter": "0.3 mm", "length": 0.01}, 128 * ETA * 0.01 / (np.pi * 3e-4**4)),
    # White, Viscous Fluid Flow: a square duct has f Re = 56.91
    "square": (
        {"width": "0.3 mm", "height": "0.3 mm", "length": 0.01},
        56.91 / 2 * ETA * 0.01 / 3e-4**4,
    ),
    "resistance": ({"resistance": 3e11}, 3e11),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_pressure_over_flow_is_the_known_resistance(shape):
    tube, resistance = SHAPES[shape]
    found = predict(study(single(tube), ["p"], pump=[1e-9, 2e-9, -1e-9]))[:, 0]
    np.testing.assert_allclose(found, resistance * np.array([1e-9, 2e-9, -1e-9]), rtol=1e-4)


def test_a_network_divides_flow_as_resistors_do():
    r = {"a": 1e11, "b": 2e11, "c": 3e11}
    model = {
        **ONE,
        "channels": [
            {"name": "a", "from": "in", "to": "j", "resistance": r["a"]},
            {"name": "b", "from": "j", "to": "left", "resistance": r["b"]},
            {"name": "c", "from": "j", "to": "right", "resistance": r["c"]},
        ],
        "sources": [
            {"node": "in", "flow": "pump"},
            {"node": "left", "pressure": 0},
            {"node": "right", "pressure": "back"},
        ],
        "meters": [
            {"channel": "qc", "flow_in": "c"},
            {"channel": "qb", "flow_in": "b"},
            {"channel": "p", "pressure_at": "in"},
            {"channel": "mid", "pressure_in": "a", "share": 0.25},
        ],
    }
    # the channels of the study in an order of their own
    s = study(model, ["p", "qb", "qc", "mid"], pump=[2e-9, 2e-9], back=[0.0, 60.0])
    junction = np.array([2e-9, 2e-9 + 60.0 / r["c"]]) / (1 / r["b"] + 1 / r["c"])
    inlet = junction + 2e-9 * r["a"]
    want = [inlet, junction / r["b"], (junction - [0.0, 60.0]) / r["c"]]
    want.append(inlet - 0.25 * (inlet - junction))
    np.testing.assert_allclose(predict(s), np.stack(want, 1), rtol=1e-9)


def test_causes_act_by_their_formulas():
    slit = SHAPES["slit"][0]
    s = study(single(slit), ["p"], pump=[1e-9, 4e-9])
    plain = predict(s)[:, 0]
    q, w, h = np.array([1e-9, 4e-9]), 2e-4, 1e-3
    np.testing.assert_allclose(predict(s, slip=1e-6)[:, 0], plain / (1 + 6e-6 / w), rtol=1e-9)
    np.testing.assert_allclose(
        predict(s, wall_offset=1e-6)[:, 0], plain * (w / (w + 2e-6)) ** 3, rtol=1e-9
    )
    np.testing.assert_allclose(predict(s, viscosity=0.1)[:, 0], 1.1 * plain, rtol=1e-9)
    np.testing.assert_allclose(predict(s, pump_gain_1=0.1)[:, 0], 1.1 * plain, rtol=1e-9)
    np.testing.assert_allclose(predict(s, pressure_scale=0.1)[:, 0], 1.1 * plain, rtol=1e-9)
    np.testing.assert_allclose(predict(s, pressure_offset_1=5.0)[:, 0], plain + 5.0, rtol=1e-9)
    lost = 0.5 * 1000.0 * 3.0 * (q / (w * h)) ** 2
    np.testing.assert_allclose(predict(s, entrance_loss=3.0)[:, 0], plain + lost, rtol=1e-9)
    r, leak = plain[0] / q[0], 1e-12
    np.testing.assert_allclose(predict(s, leak=leak)[:, 0], plain / (1 + r * leak), rtol=1e-9)
    c = 1e-3
    found = predict(s, compliance=c)[:, 0]
    np.testing.assert_allclose(((1 + c * found) ** 4 - 1) / (4 * c), plain, rtol=1e-9)
    x = np.linspace(-0.5, 0.5, 2001)
    hump = np.where(np.abs(x) < 0.25, np.cos(2 * np.pi * x) ** 2, 0.0)
    more = np.trapezoid((1 - 0.2 * hump) ** -3, x)
    np.testing.assert_allclose(predict(s, blocked_branch_1=0.2)[:, 0], more * plain, rtol=1e-6)
    # a power law at high rates: the exponent of the flow
    fast = study(single(slit), ["p"], pump=[4e-6, 8e-6])
    thin = predict(fast, thinning=0.2)[:, 0]
    assert np.log2(thin[1] / thin[0]) == pytest.approx(0.8, abs=0.002)


def test_a_resistance_that_grows_with_the_flow_is_no_thinning():
    s = study(single(SHAPES["slit"][0]), ["p"], pump=np.linspace(1e-8, 8e-8, 8))
    thinning = next(e for e in setup_of(s).effects if e.name == "thinning")
    setup = setup_of(s)
    found = {}
    for kind, sizes in {"loss": {"entrance_loss": 3.0}, "thin": {"thinning": 0.02}}.items():
        (run,) = s.runs
        made = (replace(run, measured=predict(s, **sizes)),)
        found[kind] = fit(setup.model, made, s.channels, effects=[thinning]).values["thinning"]
    assert found["loss"] == 0.0
    assert found["thin"] == pytest.approx(0.02, rel=0.1)


R = {"supply": 1e11, "link": 0.6e11, "one": 2e11, "two": 1.5e11, "three": 3e11}
JOINTED = {
    **ONE,
    "channels": [
        {"name": name, "from": start, "to": end, "resistance": {"value": R[name], "percent": 0.5}}
        for name, start, end in (
            ("supply", "in", "a"),
            ("link", "a", "b"),
            ("one", "a", "out1"),
            ("two", "b", "out2"),
            ("three", "b", "out3"),
        )
    ],
    "sources": [
        {"node": "in", "flow": "pump"},
        *({"node": f"out{k}", "pressure": 0} for k in (1, 2, 3)),
    ],
    "meters": [
        {"channel": "q1", "flow_in": "one"},
        {"channel": "q2", "flow_in": "two"},
        {"channel": "q3", "flow_in": "three"},
        {"channel": "p", "pressure_at": "in"},
    ],
}


def of_resistors(pumped, leak: float) -> np.ndarray:
    """Readings by Ohm's law: a leak at joint b is one more resistor to the ground."""
    right = 1 / R["two"] + 1 / R["three"] + leak
    branch = R["link"] + 1 / right
    a = pumped / (1 / R["one"] + 1 / branch)
    b = a / branch / right
    return np.stack([a / R["one"], b / R["two"], b / R["three"], a + R["supply"] * pumped], 1)


def test_a_leak_at_a_joint_is_a_resistor_to_the_ground():
    pumped = np.array([1e-9, 3e-9])
    s = study(JOINTED, ["q1", "q2", "q3", "p"], pump=pumped)
    names = [e.name for e in setup_of(s).effects]
    assert [n for n in names if "leak" in n] == [
        "leak",
        "leak_at_a",
        "leak_at_b",
        "leak_at_every_joint",
    ]
    np.testing.assert_allclose(predict(s, leak_at_b=1e-12), of_resistors(pumped, 1e-12), rtol=1e-9)


def test_the_joint_that_leaks_is_named():
    rng = np.random.default_rng(4)
    time, sd = np.arange(16.0), np.array([2e-12, 2e-12, 2e-12, 0.3])
    channels = tuple(
        Channel(n, u, k, float(x))
        for n, u, k, x in zip(
            ("q1", "q2", "q3", "p"),
            ("m^3/s",) * 3 + ("Pa",),
            ("flow",) * 3 + ("pressure",),
            sd,
            strict=True,
        )
    )

    def run(name, most, use="fit"):
        pumped = np.repeat(np.linspace(0.2 * most, most, 8), 2)
        seen = of_resistors(pumped, 1e-12) + sd * rng.normal(size=(16, 4))
        return Run(name, time, seen, {"pump": pumped}, name, use=use)

    runs = (run("low", 2e-9), run("high", 6e-9), run("middle", 4e-9), run("test", 8e-9, "test"))
    s = Study("joints", "flow_network", channels, runs, model=JOINTED)
    setup = setup_of(s)
    report = diagnose(s, setup.model, setup.effects, seed=0, settings=setup.settings)
    assert report.named == ("leak_at_b",)
    size = next(row for row in report.causes if row.name == "leak_at_b").size["size"]
    assert size.low < 1e-12 < size.high


@pytest.mark.cpu(8)
def test_an_elastic_supply_is_a_lag_of_many_samples_behind_a_held_pump():
    """Of 24 samples: a rate limit, play and a gain that falls were named."""
    rng, lasts, step = np.random.default_rng(3), 2.4, 0.1
    usual = {"q1": ("m^3/s", "flow", 2e-12), "p": ("Pa", "pressure", 0.3)}
    channels = tuple(Channel(name, *of) for name, of in usual.items())

    def run(name, use="fit"):
        pumped = np.repeat(rng.uniform(1e-9, 6e-9, 6), 20)
        felt = [pumped[0]]
        for flow in pumped[:-1]:
            felt.append(flow + (felt[-1] - flow) * np.exp(-step / lasts))
        seen = of_resistors(np.array(felt), 0.0)[:, [0, 3]]
        seen = seen + [c.sd for c in channels] * rng.normal(size=seen.shape)
        return Run(name, step * np.arange(len(pumped)), seen, {"pump": pumped}, name, use=use)

    only = ["lag", "delay", "rate_limit", "backlash", "gain_slope"]
    keys = {"samples": "time", "meters": [JOINTED["meters"][k] for k in (0, 3)]}
    model = {**JOINTED, **keys, "effects": {"only": only}}
    runs = (run("a"), run("b"), run("c", "test"))
    s = Study("elastic", "flow_network", channels, runs, model=model)
    setup = setup_of(s)
    assert setup.model.frame[HELD] == {"pump": True}
    report = diagnose(s, setup.model, setup.effects, seed=0, settings=setup.settings)
    assert report.named == ("lag",)
    size = next(row for row in report.causes if row.name == "lag").size["size"]
    assert size.low < lasts < size.high < 1.05 * lasts


def described(seed: int, cause: str | None = None) -> Study:
    """The laboratory's study, its network described by what its facts say."""
    given = NetworkLab()(seed) if cause is None else NetworkLab()(seed, cause)
    rows = zip(lab.CHANNELS, lab.ENDS, lab.WIDTH_M, lab.LENGTH_M, strict=True)
    model = {
        "system": "flow_network",
        "viscosity": {"value": 5e-3, "percent": 1},
        "density": lab.DENSITY_KG_M3,
        "channels": [
            {
                "name": name,
                "from": a,
                "to": b,
                "width": {"value": float(w), "percent": 0.3},
                "height": "1 mm",
                "length": float(length),
                "is_slit": True,
            }
            for name, (a, b), w, length in rows
        ],
        "sources": [
            {"node": "pump", "flow": "pump_m3_s"},
            {"node": "outlet_1", "pressure": "outlet_1_Pa"},
            {"node": "outlet_2", "pressure": 0},
            {"node": "outlet_3", "pressure": 0},
        ],
        "meters": [
            *({"channel": f"outlet_{i}_m3_s", "flow_in": f"branch_{i}"} for i in (1, 2, 3)),
            {"channel": "pump_Pa", "pressure_at": "pump"},
            {"channel": "tap_Pa", "pressure_in": "inlet", "share": lab.TAP_M / lab.LENGTH_M[0]},
        ],
    }
    return replace(given, system="flow_network", model=model)


@pytest.mark.parametrize("cause", [None, pytest.param("leak", marks=pytest.mark.slow)])
def test_hidden_causes_of_the_laboratory_are_named_and_nothing_else(cause):
    s = described(5, cause)
    setup = setup_of(s)
    report = diagnose(s, setup.model, setup.effects, settings=setup.settings, seed=0)
    assert list(report.named) == ([] if cause is None else [cause])
    # a pump that gives less than it is told to does nearly the same to a Stokes flow
    assert report.verdict == ("none" if cause is None else "ambiguous")
    assert cause is None or "May as well be: pump_gain" in report.causes[0].note


def test_channels_and_commands_that_are_not_there_are_named():
    s = study(ONE, ["q"], pumps=[1e-9])
    said = "\n".join(str(p) for p in description_of(s).problems(s))
    assert "model.meters: no channel 'p'" in said
    assert "channel q: model.meters does not name it" in said
    assert "model.sources[0]: run r has no command 'pump'; did you mean 'pumps'" in said


def plane(corrected=False, **keys) -> dict:
    facts = {n: list(at) for n, at in lab.POSITION_M.items()}
    ends = zip(lab.CHANNELS, lab.ENDS, lab.WIDTH_M, strict=True)
    return {
        "system": "flow_device",
        "network": {
            "nodes": facts,
            "channels": [
                {"name": n, "from": a, "to": b, "width": {"value": float(w), "percent": 0.3}}
                for n, (a, b), w in ends
            ],
            "outlets": ["outlet_1", "outlet_2", "outlet_3"],
            "tap": lab.TAP,
            "size": list(lab.BOX_M),
            "depth": "1 mm",
        },
        "viscosity": {"value": 5e-3, "percent": 1},
        "density": lab.DENSITY_KG_M3,
        "shear_rate": lab.SHEAR_REFERENCE_1_S,
        "drives": ["pump_m3_s"],
        "back_pressures": ["outlet_1_Pa", None, None],
        "flows": ["outlet_1_m3_s", "outlet_2_m3_s", "outlet_3_m3_s"],
        "pressures": ["pump_Pa", "tap_Pa"],
        "is_corrected": corrected,
        **keys,
    }


def test_a_plane_network_on_the_grid_is_the_laboratory_s_model():
    given = NetworkLab()(1)
    s = replace(given, system="flow_device", model=plane())
    setup = setup_of(s)
    before = network.setup(replace(given, model=None), corrected=False)
    assert {p.name: p for p in setup.model.base} == {p.name: p for p in before.model.base}
    assert [(e.name, e.typical) for e in setup.effects] == [
        (e.name, e.typical) for e in before.effects
    ]
    run = s.runs[2]
    q = setup.model.at_prior()
    torch.testing.assert_close(
        setup.model.predict(run, q), before.model.predict(run, q), rtol=0, atol=0
    )


def test_a_manifold_on_the_grid_has_the_names_of_the_study():
    manifold = {
        "inlets": [{"y": 4.566e-3, "width": 1.931e-3}],
        "outlets": [{"y": "2.035 mm", "width": 1.4e-3}, {"y": "7.119 mm", "width": 1.8e-3}],
        "size": ["12 mm", "9 mm"],
        "manifold": ["1.411 mm", "3.713 mm"],
        "fillet": "0.433 mm",
        "cells": [48, 36],
    }
    model = {
        "system": "flow_device",
        "manifold": manifold,
        "viscosity": {"value": 0.1, "percent": 2},
        "drives": ["pump"],
        "flows": ["left", "right"],
        "pressures": ["p"],
    }
    s = study(model, ["p", "right", "left"], pump=[1e-4, 2e-4])
    found = predict(s)
    # coarse cells lose a little on the way
    np.testing.assert_allclose(found[:, 1] + found[:, 2], [1e-4, 2e-4], rtol=0.02)
    assert (found[:, 1] > 1.5 * found[:, 2]).all()  # the wider outlet
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-9)
    assert "meter_gain_2" in [e.name for e in setup_of(s).effects]
    with pytest.raises(ValueError, match="flows needs 2 names"):
        description_of(study({**model, "flows": ["left"]}, ["p", "left"], pump=[1e-4]))


def test_an_end_without_pressure_is_told():
    """Two outlets of which one was forgotten: its meter would read 0 for ever."""
    tubes = [
        {"name": n, "from": "in", "to": f"out_{n}", "resistance": 1e11} for n in ("left", "right")
    ]
    meters = [{"channel": f"q_{n}", "flow_in": n} for n in ("left", "right")]
    sources = [{"node": "in", "flow": "pump"}]
    both = {**ONE, "channels": tubes, "meters": meters, "sources": sources}
    given = study(both, ["q_left", "q_right"], pump=[1e-9])
    with pytest.raises(ValueError, match=r"each open end, such as \{node: out_left, pressure: 0\}"):
        description_of(given)
    one = {**both, "sources": [*sources, {"node": "out_left", "pressure": 0}]}
    given = replace(given, model=one)
    (problem,) = description_of(given).problems(given)
    assert problem.severity == "error"
    assert "q_right measures the flow in right, which ends at out_right" in problem.message
