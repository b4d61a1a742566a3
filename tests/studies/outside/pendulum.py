"""A user's simulator: a pendulum in plain Python, Runge-Kutta of fourth order."""

import math


def predict(parameters, run, force):
    """Angle and rate at the samples."""
    inertia, damping = parameters["inertia"], parameters["damping"]

    def rate(t, u, x, v):
        push = force(t, (x,), (v,))[0] if force.acts else 0.0
        return v, (u + push - damping * v - 2.0 * math.sin(x)) / inertia

    x, v, rows = 0.0, 0.0, [(0.0, 0.0)]
    time, moment = run.time_s, run.command["moment_Nm"]
    for k in range(len(time) - 1):
        t, h, u, w = time[k], time[k + 1] - time[k], moment[k], moment[k + 1]
        a = rate(t, u, x, v)
        b = rate(t + h / 2, (u + w) / 2, x + h / 2 * a[0], v + h / 2 * a[1])
        c = rate(t + h / 2, (u + w) / 2, x + h / 2 * b[0], v + h / 2 * b[1])
        d = rate(t + h, w, x + h * c[0], v + h * c[1])
        x += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        v += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        rows.append((x, v))
    return rows
