"""A user's simulator for the tests: a pendulum in plain Python, Runge-Kutta of fourth order."""

import math

import numpy as np


class Pendulum:
    """A rod on a hinge under a commanded moment.

    Args:
        substeps: Steps between two samples.
    """

    def __init__(self, substeps: int = 2):
        self.substeps = substeps

    def predict(self, parameters, run, force=None, time_step=1.0):
        """Angle and rate at the samples."""
        inertia, damping = parameters["inertia"], parameters["damping"]
        gravity = parameters.get("gravity_moment", 2.0)
        state = (parameters.get("angle", 0.0), 0.0)
        moment = run.command.get("moment_Nm", np.zeros(len(run.time_s)))
        count = round(self.substeps / time_step)
        acts = force is not None and force.acts

        def rate(t, u, x, v):
            push = u - damping * v - gravity * math.sin(x)
            if acts:
                push += force(t, (x,), (v,))[0]
            return v, push / inertia

        rows = [state]
        for k in range(len(run.time_s) - 1):
            t0, dt = run.time_s[k], run.time_s[k + 1] - run.time_s[k]
            h, slope = dt / count, (moment[k + 1] - moment[k]) / dt
            for s in range(count):
                t = s * h
                u0, u1 = moment[k] + slope * t, moment[k] + slope * (t + h)
                state = _step(rate, t0 + t, h, u0, u1, *state)
            rows.append(state)
        return np.array(rows)


def _step(rate, t, h, u0, u1, x, v):
    um = 0.5 * (u0 + u1)
    a = rate(t, u0, x, v)
    b = rate(t + h / 2, um, x + h / 2 * a[0], v + h / 2 * a[1])
    c = rate(t + h / 2, um, x + h / 2 * b[0], v + h / 2 * b[1])
    d = rate(t + h, u1, x + h * c[0], v + h * c[1])
    x += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
    v += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
    return x, v


class Cart:
    """A cart with ``reset`` and ``step``, as Gymnasium has them, without Gymnasium."""

    dt = 0.01

    def __init__(self, mass: float = 1.0):
        self.mass, self.damping = mass, 0.5
        self.state = np.zeros(2)

    def reset(self, seed=None, options=None):
        self.state = np.zeros(2)
        return self.state.copy(), {}

    def step(self, action):
        x, v = self.state
        a = (float(action[0]) - self.damping * v) / self.mass
        self.state = np.array([x + self.dt * v, v + self.dt * a])
        return self.state.copy(), 0.0, False, False, {}


def fails_when_heavy(parameters, run):
    """A simulator that breaks."""
    if parameters["inertia"] > 0.5:
        raise ZeroDivisionError("too heavy")
    return np.zeros((len(run.time_s), 2))
