"""How many rotors, which of the catalog, how large a battery? By branch and bound.

Every choice of 4, 6 or 8 rotors, one of the shipped rotor models, a battery, and a torque that must
be left at full load is a co-design of arm lengths, rotor directions and hover. Its figures are the
payload with that torque left, the endurance without payload, and the torque. They pull apart: the
front is what no other choice surpasses in all three. Before a choice is solved its bounds are
compared with what is solved already: thrusts must carry the weight (the bound of ``codesign``), and
no hover takes less power than equal thrusts that just carry the lightest frame.

Assumed, for the shipped tables do not have them: motor and propeller weigh 38 g (5 inch), 161 g (10
inch) or 172 g (14 inch); 180 Wh/kg of which 80 % are used; 150 g and 5 W on board.

Expected: within 0.7 m 101 of 333 choices are solved, and 21 are on the front: eight 5-inch rotors
carry 2.8 kg, four 10-inch rotors hover for 32 minutes. Running time: 114 CPU seconds; 30 without
the limit on width, where the largest propellers surpass all others.

    python examples/copter/catalog.py --width 0.7 --out runs/catalog --executor processes:2
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from diffsim.cli.arguments import add_executor
from diffsim.copter import GRAVITY, hover, rotor_model, rotor_names
from diffsim.copter.airframe import Airframe, Parts
from diffsim.copter.codesign import (
    ArmSpace,
    Chosen,
    Demands,
    Limits,
    SearchOptions,
    choose,
    codesign,
)
from diffsim.copter.codesign.bound import lower_bound
from diffsim.copter.codesign.task import Task
from diffsim.core import open_executor
from diffsim.core.files import write_json_atomic

ROTOR_MASS = {0.0635: 0.038, 0.127: 0.161, 0.1778: 0.172}  # by radius of the propeller [kg], [m]
ENERGY = 0.8 * 180.0 * 3600.0  # of a battery that is used [J/kg]
ON_BOARD_KG, ON_BOARD_W = 0.15, 5.0
BATTERIES = (0.15, 0.3, 0.6)  # [kg]
TORQUES = (0.1, 0.3, 0.9)  # to be left about roll and pitch, a tenth of it about yaw [N m]
LIMITS = Limits(clearance=0.005)


@dataclass(frozen=True)
class Choice:
    """One combination."""

    rotors: int  # how many
    rotor: str  # name of the rotor model
    battery: float  # mass [kg]
    torque: float  # to be left at full load [N m]
    width: float = math.inf  # of the vehicle with its propellers, at most [m]

    @property
    def fits(self) -> bool:
        """Whether propellers that just pass each other are narrow enough."""
        radius = float(rotor_model(self.rotor).radius)
        return 2.0 * radius * (1.0 + 1.001 / math.sin(math.pi / self.rotors)) <= self.width

    @property
    def space(self) -> ArmSpace:
        """Its designs."""
        model = rotor_model(self.rotor)
        mass = ROTOR_MASS[round(float(model.radius), 4)]
        parts = Parts.of(model, rotor_mass=mass, core_mass=ON_BOARD_KG + self.battery)
        airframe = Airframe(num_pairs=self.rotors // 2, parts=parts)
        return ArmSpace(airframe=airframe, longest=min(5.0, 0.5 * self.width / parts.radius - 1.0))

    @property
    def demands(self) -> Demands:
        """The torques that are left."""
        return Demands(authority=(self.torque, self.torque, 0.1 * self.torque))

    def endurance(self, thrusts: torch.Tensor) -> float:
        """Minutes of hover with such thrusts, (n_rotors,) [N]."""
        power = float(rotor_model(self.rotor).power(thrusts).sum()) + ON_BOARD_W
        return ENERGY * self.battery / power / 60.0


def bound(choice: Choice) -> tuple[float, float, float]:
    """Payload [kg], endurance [min] and torque [N m] that no design of a choice exceeds."""
    space = choice.space
    now = float(space.multicopter(space.values).weight)
    shortest = torch.full_like(space.values, space.shortest)
    least = float(space.multicopter(shortest).weight)
    lift = now / lower_bound(Task.of(space, "payload", choice.demands, LIMITS, None))
    even = torch.full((choice.rotors,), least / choice.rotors, dtype=torch.float64)
    return (lift - least) / GRAVITY, choice.endurance(even), choice.torque


def solve(choice: Choice) -> tuple[float, float, float]:
    """The same figures of the co-designed vehicle.

    Raises:
        CoDesignError: nothing hovers with that torque left.
    """
    best = codesign(
        choice.space,
        "payload",
        spins="given",
        demands=choice.demands,
        limits=LIMITS,
        search=SearchOptions(num_starts=2),
    )
    weight = float(best.vehicle.weight)
    thrusts = hover(best.vehicle, on_infeasible="raise").thrusts
    return (best.max_weight - weight) / GRAVITY, choice.endurance(thrusts), choice.torque


def picture(found: Chosen[Choice], path: Path) -> None:
    """Payload against endurance; color is the torque, the mark the number of rotors."""
    from diffsim.viz.figures import new_figure
    from diffsim.viz.palette import save

    figure, axis = new_figure(width=8.0, height=5.0)
    figure.set_facecolor("white")
    for _, (payload, endurance, _) in found.solved:
        axis.plot(endurance, payload, ".", color="#cbd5e1", markersize=4, zorder=1)
    colors = dict(zip(TORQUES, ("#60a5fa", "#1d4ed8", "#c2410c"), strict=True))
    marks = {4: "s", 6: "h", 8: "8"}
    for choice, (payload, endurance, _) in zip(found.choices, found.figures, strict=True):
        axis.plot(
            endurance, payload, marks[choice.rotors], color=colors[choice.torque], markersize=8
        )
    for torque, color in colors.items():
        axis.plot([], [], "o", color=color, label=f"{torque:g} N m left")
    for count, mark in marks.items():
        axis.plot([], [], mark, color="#64748b", label=f"{count} rotors")
    axis.plot([], [], ".", color="#cbd5e1", label="solved, dominated")
    axis.set_xlabel("endurance without payload [min]")
    axis.set_ylabel("payload with the torque left [kg]")
    axis.legend(frameon=False, fontsize=8)
    save(figure, path)


def main(argv: Sequence[str] | None = None) -> Chosen[Choice]:
    """Search, print the front, draw it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/catalog"))
    parser.add_argument("--width", type=float, default=math.inf, metavar="M", help="at most")
    parser.add_argument("--rotor", nargs="+", choices=rotor_names(), default=rotor_names())
    add_executor(parser, "co-designs")
    args = parser.parse_args(argv)
    choices = [
        choice
        for count in (4, 6, 8)
        for rotor in args.rotor
        for battery in BATTERIES
        for torque in TORQUES
        if (choice := Choice(count, rotor, battery, torque, args.width)).fits
    ]
    with open_executor(args.executor) as executor:
        found = choose(choices, bound, solve, executor=executor)
    print(f"{'payload':>8} {'endurance':>10} {'torque':>7}")
    for choice, (payload, endurance, torque) in zip(found.choices, found.figures, strict=True):
        what = f"{choice.rotors} x {choice.rotor}, battery {choice.battery:g} kg"
        print(f"{payload:5.2f} kg {endurance:6.1f} min {torque:4.1f} Nm  {what}")
    print(
        f"{len(choices)} choices: {len(found.choices)} on the front, {len(found.solved)} solved, "
        f"{len(found.pruned)} ruled out by their bounds, {len(found.failed)} do not hover so"
    )
    rows = [
        {"rotors": c.rotors, "rotor": c.rotor, "battery_kg": c.battery, "figures": f.tolist()}
        for c, f in zip(found.choices, found.figures, strict=True)
    ]
    write_json_atomic(args.out / "front.json", rows)
    picture(found, args.out / "front.png")
    print(f"wrote {args.out / 'front.png'}")
    return found


if __name__ == "__main__":
    with interruptible():
        main()
