"""What all networks of steady flow share: the levels of what drives them, and their plant.

A channel whose walls give way to the pressure, of width w (1 + c p), is linear in
F(p) = ((1 + c p)^4 - 1) / (4 c), as its flow goes as (1 + c p)^3 dp / dx where the width changes
slowly along the channel; F(p) = p where c = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from diffsim.causes.commands import CommandGroup
from diffsim.causes.plant import IN_TIME, LATE_RECORD, Plant
from diffsim.causes.readings import usual_sample
from diffsim.causes.scales import HELD, Scales
from diffsim.causes.scene import Commands, Scene
from diffsim.causes.signals import Between
from diffsim.core.check import require_choice
from diffsim.core.errors import ConvergenceError
from diffsim.data.signal import looks_held
from diffsim.data.study import Run, Study

Samples = Annotated[
    Literal["levels", "time"],
    Field(
        description="What the samples of a run are: `levels` of the commands, each by itself, or "
        "one after the other in `time`: then what is late, lags or has play is a cause, too",
    ),
]
Parts = dict[str, dict[str, str]]
DEVICE = "device"  # what plain magnitudes are of
_ZERO = torch.zeros((), dtype=torch.float64)


def balanced(
    at: Callable[[Tensor], tuple[Tensor, Tensor]], start: Tensor, tolerance: float
) -> Tensor:
    """Flows and pressures that balance, (levels, num_unknowns), by Newton's method.

    Args:
        at: Residual of the unknowns, (levels, num_unknowns), and its slope.
        start: Where the steps begin, (levels, num_unknowns).
        tolerance: Of the largest residual.

    Raises:
        ConvergenceError: they do not balance after 60 steps; an effect is too large.

    Gradients: what the residual depends on, by the implicit function theorem; first order.
    """
    y, size, count = start, float("inf"), 60
    with torch.no_grad():
        for _ in range(count):
            residual, slope = at(y)
            size = float(residual.abs().max())
            if size <= tolerance:
                break
            y = y - torch.linalg.solve(slope, residual)
        else:
            raise ConvergenceError(
                f"flows and pressures of the network balance to {size:.1e} only after {count} "
                f"steps, needed {tolerance:.1e}; an effect is too large",
                residual_norm=size,
                tolerance=tolerance,
                num_iters=count,
            )
    residual, slope = at(y)  # one step more carries the gradients
    return y - torch.linalg.solve(slope.detach(), residual)


@dataclass(frozen=True, kw_only=True, eq=False)
class SteadyScene(Scene):
    """One run in which the flow is steady at every sample.

    Commands are what each pump gives, or each regulator holds [m^3/s, m^2/s or Pa], then what is
    held at other ends [Pa]. Numbers that only causes change are absent until one does.
    """

    num_drives: int  # number of commands that are of pumps or regulators; they come first
    rtol: float  # relative tolerance of the flow [-]
    # whether samples follow each other in time: where commands are changed on their way, samples at
    # the same level may be changed otherwise by a slope
    is_in_time: bool = False

    def several(self, name: str, count: int) -> Tensor:
        """Numbers that are counted from one, such as ``meter_1``, (count,)."""
        each = [self.number(f"{name}_{i + 1}") for i in range(count)]
        return torch.stack(each) if each else _ZERO.expand(0)

    def levels(self) -> tuple[Tensor, Tensor, Tensor]:
        """Levels of the commands.

        Returns:
            Drives (num_levels, num_drives), pressures held (num_levels, num_held) [Pa], and the
            index of the level at each sample, (num_samples,).
        """
        heard = self.commands.heard(self.grid).mT
        if self.is_in_time and self.commands.changes and heard.requires_grad:
            level = torch.arange(len(heard))
        else:
            _, first, at = np.unique(
                heard.detach().numpy(), axis=0, return_index=True, return_inverse=True
            )
            heard, level = heard[torch.from_numpy(first)], torch.from_numpy(at.reshape(-1))
        return heard[:, : self.num_drives], heard[:, self.num_drives :], level


def drive_commands(
    run: Run,
    drives: Sequence[str],
    gains: Sequence[Tensor],
    held: Sequence[str | float | None] = (),
) -> Commands:
    """Commands of a run: of the drives, by their gains, then of the pressures that are held.

    A drive is also known as ``inlet_1``, ``inlet_2`` and so on, by its place.

    Args:
        drives: Command of each pump or regulator.
        held: Command or constant of each pressure [Pa]; None, or a command that the run does not
            have: zero.

    Raises:
        ValueError: a drive whose command the run does not have.
    """
    for name in drives:
        require_choice(f"run {run.name}: command", name, run.command)
    columns = [
        run.command.get(g, 0.0) if isinstance(g, str) else g or 0.0 for g in (*drives, *held)
    ]
    values = [torch.from_numpy(np.full(len(run.time_s), c, np.float64)) for c in columns]
    values[: len(gains)] = [v * gain for v, gain in zip(values, gains, strict=False)]
    names = [given if isinstance(given, str) else "" for given in (*drives, *held)]
    made = Commands.named(names, torch.stack(values))
    inlets = {f"inlet_{i + 1}": (i,) for i in range(len(drives))}
    return Commands(made.values, {**inlets, **made.rows})


def plant_of(
    study: Study,
    *,
    kind: str,
    samples: Samples,
    pumps: Sequence[str],
    pressures: Sequence[str],
    asked: bool,
    narrowest: float | None,
    numbers: Sequence[str],
    parts: Parts,
    facts: Mapping[str, bool],
) -> Plant:
    """What a network or a device tells of itself to causes.

    What signals meet on their way is judged where samples follow each other in time, or where the
    study names causes.

    Args:
        pumps, pressures: Names of the commands.
        asked: Whether the study names the causes that are judged.
        narrowest: Width of the narrowest channel [m]; None: no channel has a width.
        numbers: Numbers that causes may change.
        parts: Parts that are alike; those of a kind of which there are none are left out.
        facts: What else holds of the system.
    """
    is_in_time = samples == "time"
    sample_s = usual_sample(study.runs) if is_in_time else 0.0
    scales = Scales.of(study, {DEVICE: {} if narrowest is None else {"narrowest": narrowest}})
    several = bool(pumps and pressures)
    groups = [  # a pump's gain is a cause of its own
        CommandGroup(
            tuple(dict.fromkeys(names)),
            scales.of_commands(names),
            between=_between(study, names) if is_in_time else "held",
            is_one_sided=scales.is_one_sided(names),
            ending=ending if several else "",
            facts=known,
            sample_s=sample_s,
        )
        for names, ending, known in (
            (pumps, "_of_pumps", ("gain_is_fitted",)),
            (pressures, "_of_pressures", ()),
        )
        if names
    ]
    few = not is_in_time and not asked
    return Plant(
        kind=kind,
        scales=scales,
        channels=study.channels,
        commands={name: group.between for group in groups for name in group.names},
        ways=tuple(groups),
        numbers=tuple(numbers),
        facts={
            IN_TIME: is_in_time,
            LATE_RECORD: not groups,
            "few_poses": few,
            "few_levels": few,
            **facts,
        },
        parts={of: names for of, names in parts.items() if names},
        magnitudes=scales.plain[DEVICE],
        sample_s=sample_s,
    )


def _between(study: Study, names: Sequence[str]) -> Between:
    """What commands do between samples: as a saved model took it, else as it looks."""
    kept = study.frame.get(HELD, {}).get(names[0])
    is_held = looks_held(study.runs, names) if kept is None else kept
    return "held" if is_held else "straight"


def meter_gains(values: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """Numbers ``meter_1`` and so on, the gain of each meter: that of flow meters, else one.

    Args:
        values: Quantities by name, ``flow_gain_1`` and so on among them.
        count: Number of meters, those of flows first.
    """
    one = torch.ones((), dtype=torch.float64)
    return {f"meter_{i + 1}": values.get(f"flow_gain_{i + 1}", one) for i in range(count)}


def counted(**counts: int) -> tuple[str, ...]:
    """Names of numbers that are counted from one, ``meter_1``, by what stands before the count."""
    return tuple(f"{name}_{i + 1}" for name, count in counts.items() for i in range(count))


def numbered(count: int, before: str = "", start: int = 1) -> dict[str, str]:
    """Parts that are counted: "1" and what stands for it, "BEFORE1", in names of numbers."""
    return {str(i): f"{before}{i}" for i in range(start, start + count)}


def linearize_pressure(pressure: Tensor, compliance: Tensor) -> tuple[Tensor, Tensor]:
    """F(p) and its slope.

    Args:
        pressure: p [Pa].
        compliance: c, relative growth of the width per pressure [1/Pa].
    """
    x = compliance * pressure
    # ((1 + x)^4 - 1) / 4 c, without a division by c
    return pressure * (1.0 + x * (1.5 + x * (1.0 + 0.25 * x))), (1.0 + x) ** 3


def invert_linearized(value: Tensor, compliance: Tensor) -> Tensor:
    """Pressure p [Pa] of F(p).

    Args:
        value: F(p) [Pa].
        compliance: c, relative growth of the width per pressure [1/Pa].
    """
    x = 4.0 * compliance * value
    # ((1 + x)^(1/4) - 1) / c, without a division by c
    root = (1.0 + x) ** 0.25
    return 4.0 * value / ((root + 1.0) * (root**2 + 1.0))
