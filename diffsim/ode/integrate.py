"""Any system of ordinary differential equations, given by formulas, as a PyTorch layer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffsim.core.check import (
    all_finite,
    require,
    require_choice,
    require_constant,
    require_threads,
)
from diffsim.core.checked import checked
from diffsim.core.errors import IntegrationError
from diffsim.core.expression import Expression, parse_expression
from diffsim.core.numbers import values_of
from diffsim.ode import _ops
from diffsim.ode.tape import make_tape

TIME = "t"


@checked
@dataclass(frozen=True, eq=False, kw_only=True)
class Ode:
    """x' = f(t, x, u, p), y = g(t, x, u, p), with f and g as formulas of named quantities.

    Attributes:
        rates: Formula of the time derivative of every state, by the state's name; text, or parsed.
        readings: Formula of every channel, by the channel's name; time is ``t``.
        inputs: Names of the inputs.
        parameters: Names of the parameters.
        held: Inputs that keep their value until the next sample; the others are linear in between.
        limits: Lower and upper limit of states that have some; kept after every step.

    Raises:
        ValueError: a formula cannot be read or names an unknown quantity, or names repeat.
    """

    rates: Mapping[str, str | Expression]
    readings: Mapping[str, str | Expression]
    inputs: Sequence[str] = ()
    parameters: Sequence[str] = ()
    held: Sequence[str] = ()
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = self.names
        if repeated := sorted({n for n in names if names.count(n) > 1}):
            raise ValueError(f"names repeat among time, states, inputs, parameters: {repeated}")
        for name in self.held:
            require_choice("held", name, self.inputs)
        for name, (low, high) in self.limits.items():
            require_choice("limits", name, self.rates)
            require_constant(f"limits of {name}", (low, high))
            if not low < high:
                raise ValueError(f"limits of {name} must be (low, high), got ({low:g}, {high:g})")
        _ = self._arrays  # formulas are read once, and mistakes in them show here

    @property
    def names(self) -> list[str]:
        """Quantities of the formulas: time, states, inputs, parameters."""
        return [TIME, *self.rates, *self.inputs, *self.parameters]

    def _parse_formulas(
        self, what: str, formulas: Mapping[str, str | Expression]
    ) -> list[Expression]:
        out = []
        for name, given in formulas.items():
            if isinstance(given, Expression):
                for needed in given.names:
                    require_choice(f"{what} of {name}: quantity", needed, self.names)
                out.append(given)
                continue
            try:
                out.append(parse_expression(given, self.names))
            except ValueError as error:
                raise ValueError(f"{what} of {name}: {error}") from None
        return out

    @checked
    def solve(
        self,
        times: Tensor,
        start: Tensor,
        inputs: Tensor | None = None,
        parameters: Tensor | None = None,
        *,
        num_steps: int = 1,
        num_threads: int = 1,
        finite: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """Integrate by the classical Runge-Kutta method, fixed steps between samples.

        Args:
            times: Sample times, (num_samples,) or (batch, num_samples) float64, increasing [s].
            start: States at the first sample, (num_states,) or (batch, num_states).
            inputs: At the samples, (num_samples, num_inputs), or with a leading batch axis.
            parameters: (num_parameters,) or (batch, num_parameters).
            num_steps: Steps between two samples.
            num_threads: Worker threads; results do not depend on it.
            finite: Whether NaN and infinity are an error; else they are returned, for callers
                that judge each member of a batch.

        Returns:
            Readings, (num_samples, num_channels), and states, (num_samples, num_states), both with
            a leading batch axis where an argument has one. Gradients: start, inputs, parameters;
            any order, exact for the steps that were computed.

        Raises:
            ValueError: shapes disagree, times do not increase or require a gradient.
            IntegrationError: a state or reading is no number: a formula has no value there (the
                logarithm of a negative number), or steps are too long.
        """
        num_threads = require_threads(num_threads)
        n, m, q = len(self.rates), len(self.inputs), len(self.parameters)
        require_constant("times", times, "a time that is sought can scale all rates")
        times = require("times", times, ("...", "num_samples"))
        if not bool((times.diff() > 0).all()):
            raise ValueError("times must increase from sample to sample")
        if num_steps < 1:
            raise ValueError(f"num_steps must be 1 or more, got {num_steps}")
        num_samples = times.shape[-1]
        inputs = times.new_zeros((num_samples, 0)) if inputs is None else inputs
        parameters = times.new_zeros(0) if parameters is None else parameters
        start = require("start", start, ("...", n))
        if times.ndim == 2 and start.ndim == 1:
            start = start.expand(len(times), n)
        inputs = require("inputs", inputs, ("...", num_samples, m))
        parameters = require("parameters", parameters, ("...", q))
        given = ((times, 2), (start, 2), (inputs, 3), (parameters, 2))
        sizes = {len(a) for a, d in given if a.ndim == d}
        if len(sizes - {1}) > 1 or any(a.ndim > d for a, d in given):
            raise ValueError(
                f"batch axes of times, start, inputs, parameters disagree: {sorted(sizes)}"
            )
        problem = self.problem(times, num_steps, num_threads)
        readings, states = integrated(self, problem, start, inputs, parameters)
        if finite:
            self._require_finite(times, readings, states)
        return readings, states

    def _require_finite(self, times: Tensor, readings: Tensor, states: Tensor) -> None:
        if torch.compiler.is_compiling():
            return  # without values
        parts = [values_of(part.detach()) for part in (states, readings)]
        if all(all_finite(part) for part in parts):
            return
        seen = torch.cat(parts, -1)
        lost = ~seen.reshape(-1, *states.shape[-2:-1], seen.shape[-1]).isfinite()
        item, sample, quantity = (int(i) for i in lost.nonzero()[0])
        name = [*self.rates, *self.readings][quantity]
        time = float(times.expand(len(lost), -1)[item, sample])
        of = f" of item {item}" if len(lost) > 1 else ""
        raise IntegrationError(
            f"{name}{of} is no number from {time:g} s on: a formula has no value "
            f"there, or the steps are too long; look at its terms, or raise num_steps",
            item=item,
            time=time,
        )

    @checked
    def problem(self, times: Tensor, num_steps: int, num_threads: int) -> dict[str, Any]:
        """Arguments of the ops that do not depend on values."""
        return self._arrays | {
            "times": times if times.ndim == 2 else times[None],
            "num_steps": num_steps,
            "num_threads": num_threads,
        }

    @cached_property
    def _arrays(self) -> dict[str, Tensor]:
        """Formulas as the kernel reads them, and what else is the same in every call."""
        kinds = {"state": self.rates, "input": self.inputs, "parameter": self.parameters}
        named = {name: kind for kind, names in kinds.items() for name in names}
        tape = make_tape(
            {TIME: "time"} | named,
            self._parse_formulas("rate", self.rates),
            self._parse_formulas("reading", self.readings),
        )
        limits = [self.limits.get(s, (-math.inf, math.inf)) for s in self.rates]
        lower, upper = torch.tensor(limits, dtype=torch.float64).reshape(-1, 2).unbind(-1)
        return {
            "code": tape.code,
            "ends": tape.ends,
            "rate_out": tape.rates,
            "reading_out": tape.readings,
            "constants": tape.constants,
            "lower": lower.contiguous(),
            "upper": upper.contiguous(),
            "held": torch.tensor([name in self.held for name in self.inputs], dtype=torch.int64),
        }


def integrated(
    ode: Ode, problem: Mapping[str, Any], start: Tensor, inputs: Tensor, parameters: Tensor
) -> tuple[Tensor, Tensor]:
    """``Ode.solve`` of what is known to fit, for callers that ask thousands of times.

    Args:
        problem: Of ``Ode.problem``.
        start, inputs, parameters: As ``Ode.solve`` takes them; both of the latter are there.

    Returns:
        Readings and states as ``Ode.solve`` returns them; NaN and infinity stay in them.
    """
    sizes = {len(a) for a, d in ((start, 2), (inputs, 3), (parameters, 2)) if a.ndim == d}
    sizes |= {len(problem["times"])} - {1}
    batch = max(sizes, default=1)
    readings, states = _ops.ode_integrate(
        **problem,
        start=start.expand(batch, len(ode.rates)),
        inputs=inputs if inputs.ndim == 3 else inputs[None],
        parameters=parameters.expand(batch, len(ode.parameters)),
    )
    return (readings, states) if sizes else (readings[0], states[0])
