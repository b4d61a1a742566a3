"""The model of a system of formulas: several runs are integrated at once.

The integrator takes members of a batch side by side, each with its own times and inputs. A run at
one point fills one of its lanes, and takes as long as with all of them full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffsim.core.checked import checked
from diffsim.identify.model import Asked, SimModel, joined
from diffsim.identify.numerics import NumericalEffect, Numerics
from diffsim.ode.integrate import integrated
from diffsim.systems.ode.scene import Flow, OdeScene

LANES = 16  # members that the integrator takes at once; a batch of as many gains by no other


class OdeModel(SimModel):
    """A model whose scenes are systems of formulas."""

    leaves_zeros = True
    joins_runs = True

    @checked(kinds_only=True)
    def predict_each(
        self, asked: Sequence[Asked], numerics: Numerics | None = None
    ) -> list[Tensor]:
        """Predictions as of ``SimModel``, with the same bits, those of few points together."""
        every = (pair for a in asked for pair in a.sizes.items())
        is_refined = any(isinstance(e, NumericalEffect) and bool(s.any()) for e, s in every)
        if torch.is_grad_enabled() or is_refined:
            return super().predict_each(asked, numerics)
        made = [self._list_scenes(a, numerics) for a in asked]
        found = iter(simulate_together([scene for _, scenes in made for scene in scenes]))
        parts = [(rows, [next(found) for _ in scenes]) for rows, scenes in made]
        return [joined(rows, own) if rows else own[0] for rows, own in parts]

    def _list_scenes(
        self, asked: Asked, numerics: Numerics | None
    ) -> tuple[list[list[int]], list[Any]]:
        """Scenes of a run with the points of each; none of these where it is one point."""
        run, q, sizes = asked
        if q.ndim == 1:
            self.note_simulations(run, 1, numerics)
            return [], [self.scene(run, q, sizes, numerics)]
        self.note_simulations(run, len(q), numerics)
        return self.grouped_scenes(run, q, sizes, numerics)


def simulate_together(scenes: Sequence[OdeScene]) -> list[Tensor]:
    """Predicted channels of scenes of any runs, as each ``simulate`` gives them, to the bit.

    Args:
        scenes: Runs at points; those of the same formulas are integrated together.
    """
    out: list[Tensor | None] = [None] * len(scenes)
    flows: dict[int, tuple[int, Flow]] = {}
    for k, scene in enumerate(scenes):
        flow = None if scene.restarts else scene.flow()
        if flow is None or math.prod(flow.lead) >= LANES:
            out[k] = scene.simulate()
        else:
            flows[k] = k, flow
    for group in _list_groups([flows[k] for k in sorted(flows)]):
        readings = _integrate_together([flow for _, flow in group])
        for (k, _), own in zip(group, readings, strict=True):
            out[k] = scenes[k].read(own)
    return [part for part in out if part is not None]


def _list_groups(flows: Sequence[tuple[int, Flow]]) -> list[list[tuple[int, Flow]]]:
    """Flows of the same formulas, those of like length together, as many as fill all lanes."""
    groups: list[list[tuple[int, Flow]]] = []
    room, last = 0, None
    for item in sorted(flows, key=lambda f: (id(f[1].ode), -len(f[1].times), f[0])):
        flow, members = item[1], math.prod(item[1].lead)
        if flow.ode is not last or members > room:
            groups.append([])
            room, last = LANES, flow.ode
        groups[-1].append(item)
        room -= members
    return groups


def _integrate_together(flows: Sequence[Flow]) -> list[Tensor]:
    """Readings of flows of the same formulas, (..., num_times, num_channels); the shorter ones
    stay where they end."""
    longest = max(len(flow.times) for flow in flows)
    counts = [math.prod(flow.lead) for flow in flows]
    times, starts, inputs, parameters = [], [], [], []
    for flow, count in zip(flows, counts, strict=True):
        times.append(_lengthened(flow.times[:, None], longest)[:, 0].expand(count, -1))
        starts.append(flow.start.reshape(count, -1))
        given = flow.inputs.expand(*flow.lead, *flow.inputs.shape[-2:])
        inputs.append(_lengthened(given.reshape(count, *given.shape[-2:]), longest))
        parameters.append(flow.parameters.reshape(count, -1))
    ode = flows[0].ode
    problem = ode.problem(torch.cat(times), 1, 1)
    readings, _ = integrated(
        ode, problem, torch.cat(starts), torch.cat(inputs), torch.cat(parameters)
    )
    parts = zip(flows, readings.split(counts), strict=True)
    return [part[:, : len(f.times)].reshape(*f.lead, len(f.times), -1) for f, part in parts]


def _lengthened(rows: Tensor, longest: int) -> Tensor:
    """Rows (..., num_times, width) with the last one repeated."""
    missing = longest - rows.shape[-2]
    if missing == 0:
        return rows
    last = rows[..., -1:, :]
    return torch.cat([rows, last.expand(*last.shape[:-2], missing, -1)], -2)
