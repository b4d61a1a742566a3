"""A toy bed: a driven oscillator with two sensors, and a generator that shares no code with it.

Model: x'' = w^2 (g u(t) - x) - 2 zeta w x' + terms, RK4 at the sample times, many points at once,
smoothed friction. Generator: scipy's DOP853 at rtol 1e-7, sharp nonlinearities, colored noise,
0.5 % gain jitter, placement errors.
"""

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy import integrate

from diffsim.data.study import Channel, Run, Study
from diffsim.identify import Effect, Numerics, Parameter, SimModel
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from tests.diagnose import toy_steps

RATE_HZ, DURATION_S = 50.0, 4.0
TIME = np.arange(round(RATE_HZ * DURATION_S)) / RATE_HZ
CHANNELS = (
    Channel("position_m", "m", "position", sd=0.03),
    Channel("velocity_m_s", "m/s", "velocity", sd=0.3),
)
COMMANDS = {
    "chirp": np.sin(2 * np.pi * (0.4 * TIME + 0.3 * TIME**2)),
    "steps": np.interp(TIME, [0, 0.3, 0.5, 2.0, 2.2, 4.0], [0, 0, 0.8, 0.8, -0.4, -0.4]),
    "small": 0.35 * np.sin(2 * np.pi * 1.3 * TIME) * np.minimum(TIME, 1.0),
    "held": 0.9 * np.sin(2 * np.pi * 0.9 * TIME) * np.minimum(2.0 * TIME, 1.0),
}


@dataclass
class OscillatorScene:
    """Terms of the model; effects add to them. All entries may carry a batch axis (K,)."""

    values: dict[str, Any]
    run: Run
    numerics: Numerics
    implicit_step: float | None
    terms: dict[str, Any] = field(default_factory=dict)

    def simulate(self) -> torch.Tensor:
        """(..., T, 2) position and velocity."""
        get = {k: np.atleast_1d(v.detach().numpy())[:, None] for k, v in self.values.items()}
        terms = {k: np.atleast_1d(v.detach().numpy()) for k, v in self.terms.items()}
        single = self.values["frequency"].ndim == 0
        count = len(get["frequency"])
        column = {k: v[:, None] if v.ndim == 1 else v for k, v in terms.items()}
        zero = np.zeros((count, 1))
        order = self.run.order
        w = 2 * np.pi * get["frequency"][:, 0] * (1 + column.get("warming", zero)[:, 0] * order)
        zeta = get["damping_ratio"][:, 0]
        stages = np.linspace(0.0, TIME[-1], 2 * len(TIME) - 1)
        shifted = stages[None, :] - column.get("delay", zero)
        u = np.interp(shifted, TIME, self.run.command["u"], left=self.run.command["u"][0])
        u = np.broadcast_to(u, (count, len(stages)))
        if np.any(tau := column.get("lag", zero)):
            u = lagged(u, stages[1], tau)
        gain = get["gain"] * get.get(f"gain_factor@{self.run.name}", zero + 1.0)
        push = gain * u + column.get("bias", zero)
        if "knots" in terms:
            knots = np.linspace(0.0, TIME[-1], terms["knots"].shape[-1])
            hats = np.stack([np.interp(stages, knots, e) for e in np.eye(len(knots))])
            push = push + terms["knots"].reshape(count, -1) @ hats
        if self.implicit_step is None:
            named = [column.get(k, zero)[:, 0] for k in ("stiffening", "drag", "friction")]
            x, v = toy_steps.rk4(each(count, w * w, 2 * zeta * w, *named), push, TIME[1])
        else:
            substeps = max(round(TIME[1] / (self.implicit_step * self.numerics.time_step)), 1)
            h = TIME[1] / substeps  # a step that divides the sample distance
            x, v = toy_steps.implicit_euler(each(count, w, zeta), push, h, substeps)
        place = get.get(f"offset@{self.run.name}", zero)
        out = np.stack([x + place, v * (1 + column.get("scale", zero))], axis=-1)
        return torch.from_numpy(out[0] if single else out)


def each(count: int, *columns: np.ndarray) -> np.ndarray:
    """Terms of each point beside one another, (count, terms)."""
    return np.stack([np.broadcast_to(c, count) for c in columns], axis=1)


def lagged(u, h, tau):
    """First-order lag of a piecewise linear signal, exactly; starts settled."""
    tau = np.maximum(np.abs(tau[:, 0]), 1e-9)
    decay, out = np.exp(-h / tau), np.array(u)
    for k in range(u.shape[1] - 1):
        slope = (u[:, k + 1] - u[:, k]) / h
        behind = out[:, k] - u[:, k] + tau * slope
        out[:, k + 1] = u[:, k + 1] - tau * slope + behind * decay
    return out


def term(name: str, family: str, typical: float, term: str = "", **more: Any) -> Effect:
    """An effect that adds its size to a term of the scene, by default the one of its name."""

    def apply(scene, size, run):
        before = scene.terms.get(term or name, 0.0)
        return replace(scene, terms={**scene.terms, term or name: before + size[..., 0]})

    settings = {"kind": "force", "unit": "-", **more}
    return Effect(name=name, family=family, typical=typical, apply=apply, **settings)


DRAG = term(
    "drag",
    "damping",
    0.3,
    signed=False,
    also_looks_like=("turbulent drag of the surroundings",),
)
FRICTION = term("friction", "friction", 1.0, signed=False, smooth=False)
STIFFENING = term("stiffening", "stiffness", 0.1)
DELAY = term("delay", "timing", 0.03, signed=False, kind="actuator")
LAG = term("lag", "timing", 0.03, signed=False, kind="actuator")
BIAS = term("bias", "load", 0.1)
SCALE = term("scale", "sensor", 0.1, kind="sensor")
WARMING = term("warming", "temperature", 0.01, kind="environment")
CLOCK_OFFSET = term("clock_offset", "timing", 0.03, "delay", signed=False, kind="actuator")
"""Exactly the delay under another name."""


def _with_knots(scene, size, run):
    return replace(scene, terms={**scene.terms, "knots": size})


KNOTS = Effect(
    name="knots",
    form="The unknown force's coefficients, in units of the command.",
    family="unknown",
    kind="force",
    unit="-",
    typical=0.1,
    components=tuple(f"t{i}" for i in range(21)),
    apply=_with_knots,
)
LIBRARY = (DRAG, FRICTION, STIFFENING, DELAY, LAG, BIAS, SCALE, WARMING)


def unknown_force() -> UnknownForce:
    knots = np.linspace(0.0, TIME[-1], 21)
    return UnknownForce(KNOTS, smooth_covariance(knots, 0.3))


def model(runs, implicit_step: float | None = None) -> SimModel:
    base = [
        Parameter("frequency", 1.5, 0.1, "Hz", log=True),
        Parameter("damping_ratio", 0.08, 0.3, "-", log=True),
        Parameter("gain", 1.0, 0.1, "-", log=True),
        *(Parameter(f"offset@{r.name}", 0.0, 0.02, "m") for r in runs),
        *(Parameter(f"gain_factor@{r.name}", 1.0, 0.005, "-") for r in runs),
    ]
    return SimModel(
        lambda values, run, numerics: OscillatorScene(dict(values), run, numerics, implicit_step),
        base,
        "oscillator",
        batched=True,
    )


def generate(
    seed: int,
    hidden: dict[str, float] | None = None,
    *,
    color: float = 0.4,
    tails: bool = False,
    spikes: bool = False,
    scatter: float = 0.0,
    lost_repeat: bool = False,
    far_base: float = 1.0,
    noise: float = 1.0,
) -> Study:
    """Recordings of a hidden truth: 3 commands x 2 repeats to fit, one command held out."""
    options = (color, tails, spikes, scatter, lost_repeat, far_base)
    runs = [
        Run(
            f"{command}_{repeat}",
            TIME,
            clean + noise * disturbed + nuisance,
            {"u": COMMANDS[command]},
            command,
            order,
            "test" if command == "held" else "fit",
        )
        for command, repeat, order, clean, disturbed, nuisance in _recordings(
            seed, tuple((hidden or {}).items()), *options
        )
    ]
    return Study("toy", "soft_body", CHANNELS, tuple(runs))


@lru_cache(maxsize=16)  # with and without noise, and for each test of the same
def _recordings(seed, hidden, color, tails, spikes, scatter, lost_repeat, far_base):
    """Command, repeat, order, clean record, noise, placement and spikes of every run."""
    rng, hidden = np.random.default_rng(seed), dict(hidden)
    truth = {
        "w": 2 * np.pi * 1.5 * np.exp(0.1 * far_base * _prior(rng)),
        "zeta": 0.08 * np.exp(0.3 * far_base * _prior(rng)),
        "gain": np.exp(0.1 * far_base * _prior(rng)),
    }
    out = []
    plan = [(c, r) for r in "ab" for c in ("chirp", "steps", "small")] + [("held", "a")]
    for order, (command, repeat) in enumerate(plan):
        if lost_repeat and (command, repeat) == ("steps", "b"):
            continue
        clean = _integrate(truth, COMMANDS[command], hidden, order, rng, scatter)
        disturbed = _noise(rng, color, tails) * [c.sd for c in CHANNELS]
        nuisance = np.array([rng.normal(0.0, 0.01), 0.0])
        if spikes:
            hit = rng.random(clean.shape) < 0.005
            nuisance = nuisance + hit * rng.choice([-1, 1], clean.shape) * [0.8, 8.0]
        out.append((command, repeat, order, clean, disturbed, nuisance))
    return out


def _prior(rng) -> float:
    return float(np.clip(rng.normal(), -2, 2))


def _noise(rng, color, tails):
    from scipy.signal import lfilter

    white = (
        rng.standard_t(3, (len(TIME) + 50, 2)) / np.sqrt(3)
        if tails
        else rng.normal(size=(len(TIME) + 50, 2))
    )
    return lfilter([np.sqrt(1 - color**2)], [1, -color], white, axis=0)[50:]


def _integrate(truth, command, hidden, order, rng, scatter):
    get = hidden.get
    w = truth["w"] * (1 + get("warming", 0.0) * order)
    gain = truth["gain"] * (1 + 0.005 * rng.normal()) * (1 + scatter * rng.normal())
    tau = get("lag", 0.0)
    kick = scatter * rng.normal(size=8)
    samples, delay = command.tolist(), get("delay", 0.0)

    def slope(t, y):
        x, v, a = y.tolist()
        # linear between samples; scalars of Python are several times as fast as numpy's
        place = min(max((t - delay) * RATE_HZ, 0.0), len(samples) - 1.0)
        k = min(int(place), len(samples) - 2)
        u = samples[k] + (place - k) * (samples[k + 1] - samples[k])
        pushed = gain * (a if tau > 0 else u) + get("bias", 0.0)
        pushed += get("pulse", 0.0) * math.exp(-(((t - 1.7) / 0.2) ** 2))
        if scatter:
            pushed += scatter * sum(k * math.sin((i + 1) * t) for i, k in enumerate(kick)) / 2
        stop = get("stop", 0.0) * max(x - 0.35, 0.0)
        tide = 1 + get("tide", 0.0) * math.sin(2 * math.pi * 0.6 * t)
        force = w * w * (pushed - tide * x - get("stiffening", 0.0) * x**3 - stop)
        force -= 2 * truth["zeta"] * w * v + get("drag", 0.0) * abs(v) * v
        force -= get("friction", 0.0) * math.tanh(v / 0.004)
        return [v, force, (u - a) / tau if tau > 0 else 0.0]

    method = "LSODA" if get("friction", 0.0) else "DOP853"
    found = integrate.solve_ivp(
        slope,
        (0, TIME[-1]),
        [0, 0, command[0]],
        t_eval=TIME,
        rtol=1e-7,
        atol=1e-8,
        method=method,
        max_step=0.05,
    )
    if not found.success:
        raise RuntimeError(f"generator: {found.message} with {hidden}")
    x, v = found.y[:2]
    return np.column_stack([x, v * (1 + get("scale", 0.0))])
