"""What a loop keeps: settings, plans made before an experiment, rows of its table; its folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import require_number
from diffsim.core.files import to_plain, write_json_atomic
from diffsim.data.study import Run
from labs.loop.command import Command
from labs.loop.hardware import Hardware
from labs.loop.identification import FitSettings, Identified
from labs.loop.model import Starfish
from labs.loop.trajectory import TrajectorySettings

Array = NDArray[np.float64]
_MAY_CHANGE = ("max_iterations", "tolerance")  # of a loop that is resumed


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """How long the loop goes on, and how its two optimizations are made.

    Attributes:
        max_iterations: After the baseline.
        tolerance: Converged where the measured speed changes by less than this share.
        memory: Latest recordings that parameters are fitted to; 1 in Alg. 7.
        fit, trajectory: Settings of the optimizations.
    """

    max_iterations: int = 5
    tolerance: float = 0.03
    memory: int = 1
    fit: FitSettings = field(default_factory=FitSettings)
    trajectory: TrajectorySettings = field(default_factory=TrajectorySettings)

    def __post_init__(self) -> None:
        require_number("max_iterations", self.max_iterations, at_least=1)
        require_number("tolerance", self.tolerance, at_least=0.0)
        require_number("memory", self.memory, at_least=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Iteration:
    """One row of Table 5.2, with what it was made from.

    Iteration 0 is bl-ctrl: the first guesses and the hand-made command. Iteration 1 is bl-one-iter.
    """

    idx: int  # number of the iteration, from 0
    values: dict[str, float]  # theta, by name, that ``command`` was optimized for
    # how theta was found, from the recordings before; None in iteration 0
    identified: Identified | None
    # L_theta [m^2]: of theta on the recordings that it was fitted to; in iteration 0 of the first
    # guesses on the recording of this command
    loss_theta: float
    loss_action: float  # L_a of ``command`` with theta [m]
    loss_action_before: float  # L_a of the command before, with theta [m]
    command: Command  # executed in this iteration
    run: Run  # recording of that command
    # (num_samples,) x of the center of mass, simulated with theta for ``command``, from its start
    # [m]
    center_m: Array
    markers_m: Array  # (num_samples, 8) displacements of the markers, simulated, as ``center_m``
    speed_simulated: float  # v_s, predicted before the experiment [m/s]
    speed_measured: float  # v_r [m/s]


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopResult:
    """What the loop found.

    Attributes:
        iterations: Iterations in order; the first is bl-ctrl, the second bl-one-iter.
        converged: Whether the measured speed stopped changing before the iterations ran out.
        hardware: Name of the hardware.
        virtual: Whether no matter moved.
    """

    iterations: tuple[Iteration, ...]
    converged: bool
    hardware: str
    virtual: bool

    @property
    def best(self) -> Iteration:
        """The iteration with the highest measured speed."""
        return max(self.iterations, key=lambda i: i.speed_measured)

    @property
    def best_so_far(self) -> list[float]:
        """Highest measured speed up to each iteration [m/s]; never falls."""
        return np.maximum.accumulate([i.speed_measured for i in self.iterations]).tolist()


@dataclass(frozen=True, eq=False)
class IterationPlan:
    """What is known before the experiment."""

    values: dict[str, float]
    command: Command
    identified: Identified | None
    loss_action: float
    loss_action_before: float


def open_loop(
    folder: Path, model: Starfish, hardware: Hardware, settings: LoopSettings, resume: bool
) -> None:
    """Make a loop's folder, or make sure that it holds the same loop.

    Raises:
        FileExistsError, ValueError: see :func:`~labs.loop.sim_to_real`.
    """
    file = folder / "loop.json"
    now = to_plain(
        {
            "hardware": hardware.name,
            "duration_s": hardware.duration_s,
            "limits": asdict(hardware.limits),
            "settings": asdict(settings),
            "model": _plain_model(model),
        }
    )
    if not file.exists():
        write_json_atomic(file, now)
        return
    if not resume:
        raise FileExistsError(f"{folder} already holds a loop; resume it or take another folder")
    then = json.loads(file.read_text())
    # more iterations may be asked for; everything else would mix two loops
    for entry in (now, then):
        entry["settings"] = {k: v for k, v in entry["settings"].items() if k not in _MAY_CHANGE}
    if changed := [key for key in now if now[key] != then.get(key)]:
        raise ValueError(
            f"{folder} holds a loop with another {' and '.join(changed)}; resume it with the same, "
            "or take another folder"
        )


def _plain_model(model: Starfish) -> dict[str, Any]:
    """The model for JSON; of causes their names, for sizes are parameters."""
    plain = asdict(replace(model, causes=()))
    del plain["causes"], plain["command"]
    causes = [effect.name for effect in model.causes]
    return {**plain, "causes": causes} if causes else plain


def load_plan(place: Path) -> IterationPlan | None:
    """The saved plan of an iteration, None where there is none."""
    file = place / "plan.json"
    if not file.exists():
        return None
    saved: dict[str, Any] = json.loads(file.read_text())
    found = saved["identified"]
    return IterationPlan(
        saved["values"],
        Command(np.array(saved["contraction_m"])),
        None if found is None else Identified.from_plain(found),
        saved["loss_action"],
        saved["loss_action_before"],
    )


def save_plan(place: Path, planned: IterationPlan) -> IterationPlan:
    """Keep it on disk, and hand it on."""
    found = planned.identified
    write_json_atomic(
        place / "plan.json",
        {
            "values": planned.values,
            "contraction_m": planned.command.contraction_m,
            "identified": None if found is None else found.plain(),
            "loss_action": planned.loss_action,
            "loss_action_before": planned.loss_action_before,
        },
    )
    return planned
