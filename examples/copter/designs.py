"""Do the six multicopters of the thesis hover, and fly to a target?

X quadcopter with a printed frame, Y6 hexacopter of coaxial pairs, bunny with four different
propellers at different heights, flat pentacopter and its payload-optimized twin, quadcopter and its
twin with larger propellers on a longer arm (thesis 3.7, Figs. 3-5 to 3-8). For each: mass and size,
hover thrusts, largest weight that hovers, battery life, LQR (Q = diag, R = I), and a flight under
that regulator from rest to a point 2 m ahead, 1 m to the right and 1.5 m up, with motors that lag
by 0.05 s. One step of the regulator is 5 ms.

Expected: all hover and arrive within 0.1 m of the target after 5.1 to 5.2 s. The payload twin lifts
5.94 kg overall instead of 4.76 kg (24.9 % more), the flight-time twin hovers for 11.2 instead of
10.1 minutes. The bunny's smallest motor works at 85 % in hover and saturates on the way. The 8- and
12-inch propellers were never measured, so that the bunny has no battery life. Running time: 3 CPU
seconds, with pictures 15.

    python examples/copter/designs.py                                  # all, numbers only
    python examples/copter/designs.py bunny --out runs/copter          # with picture
    python examples/copter/designs.py pentacopter_payload --out runs/copter --fabricate
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from diffsim.copter import (
    GRAVITY,
    Battery,
    Design,
    Feedback,
    Flight,
    FlightEffects,
    FlightState,
    HoverResult,
    MotorLag,
    Multicopter,
    fly,
    hover,
    linearize,
    load_design,
    lqr,
    max_hover_weight,
    response_time,
    rotor_model,
    rotor_names,
    shipped_designs,
)

DT = 0.005  # [s]
TARGET = (2.0, 1.0, -1.5)  # north, east, down [m]
ARRIVED = 0.1  # [m]
LAG = 0.05  # of the motors [s]
# position, attitude, velocity, rates of attitude: a meter off weighs as much as 0.3 rad
Q = (1.0,) * 3 + (10.0,) * 3 + (2.0,) * 3 + (1.0,) * 3


@dataclass(frozen=True)
class Story:
    """One design, hovering and flying."""

    design: Design
    copter: Multicopter
    trim: HoverResult
    gain: Tensor
    flight: Flight
    numbers: dict[str, float]


def battery_life(copter: Multicopter, thrusts: Tensor) -> float:
    """Hover on three cells of 2.2 A h down to 5 % [min]; NaN where a rotor was not measured."""
    if not set(copter.rotor_models) <= set(rotor_names()):
        return float("nan")
    models = [rotor_model(name) for name in copter.rotor_models]
    power = sum(model.power(u) for model, u in zip(models, thrusts, strict=True))
    return float(Battery.lipo(cells=3, capacity_mah=2200.0).endurance(power)) / 60.0


def regulator(copter: Multicopter, trim: HoverResult) -> tuple[Tensor, float]:
    """LQR gain, (n_rotors, 12), and the slowest time constant of the closed loop [s]."""
    A, B = linearize(copter, trim.thrusts, trim.attitude)
    gain = lqr(A, B, torch.diag(torch.tensor(Q)).double(), torch.eye(copter.num_rotors).double()).K
    return gain, float(response_time(A, B, gain))


def fly_to(
    copter: Multicopter, trim: HoverResult, gain: Tensor, target: Tensor, seconds: float
) -> Flight:
    """From rest at the origin to a target, (3,) [m]."""
    hovering = torch.zeros(12, dtype=torch.float64)
    hovering[3:5] = trim.attitude
    there = hovering.clone()
    there[:3] = target
    return fly(
        copter,
        FlightState.from_minimal(hovering[None]),
        trim.thrusts.expand(1, round(seconds / DT), -1).contiguous(),
        dt=DT,
        feedback=Feedback(gain=gain, reference=there),
        effects=FlightEffects(
            motor_lag=MotorLag(time_constants=torch.full_like(trim.thrusts, LAG))
        ),
    )


def tell(name: str, seconds: float = 8.0) -> Story:
    """Load, measure, hover, regulate, fly."""
    design = load_design(name)
    copter = design.multicopter().detach()
    trim = hover(copter, on_infeasible="raise")
    gain, slowest = regulator(copter, trim)
    target = torch.tensor(TARGET, dtype=torch.float64)
    flight = fly_to(copter, trim, gain, target, seconds)
    away = (flight.state.position[0] - target).norm(dim=-1)
    late = torch.nonzero(away > ARRIVED)
    arrival = float(flight.time[int(late.max())]) + DT if len(late) else 0.0
    lift = float(max_hover_weight(copter))
    tilt = torch.rad2deg(torch.arccos((-copter.directions[:, 2]).clamp(-1.0, 1.0))).max()
    numbers = {
        "mass [g]": 1e3 * float(copter.mass),
        "length of rods [m]": float(design.size()),
        "price [EUR]": float(design.cost()),
        "largest motor angle [deg]": float(tilt),
        "largest overall weight [g]": 1e3 * lift / GRAVITY,
        "largest payload [g]": 1e3 * (lift / GRAVITY - float(copter.mass)),
        "largest share of a rotor in hover [%]": 100.0
        * float((trim.thrusts / copter.max_thrusts).max()),
        "battery life [min]": battery_life(copter, trim.thrusts),
        "slowest time constant [s]": slowest,
        "arrival within 0.1 m [s]": arrival,
        "distance at the end [mm]": 1e3 * float(away[-1]),
        "largest lean on the way [deg]": float(
            torch.rad2deg(flight.state.rpy[0, :, :2].abs().max())
        ),
    }
    return Story(design, copter, trim, gain, flight, numbers)


def draw(story: Story, path: Path) -> None:
    """The copter, its way to the target, its thrusts."""
    from diffsim.viz.fabrication_figures import view
    from diffsim.viz.figures import CYCLE, INK, SOFT, new_figure

    path.parent.mkdir(parents=True, exist_ok=True)
    design = story.design
    kinds = {p.name: p.part.kind for p in design.parts}
    picture = view(design.meshes(), kinds)
    picture.set_facecolor("white")
    picture.savefig(path.with_name(f"{path.stem}_parts.png"), dpi=110)
    figure, (way, push) = new_figure(1, 2, width=9.6, height=3.4)
    figure.set_facecolor("white")
    time = story.flight.time.numpy()
    position = story.flight.state.position[0].numpy()
    for k, axis in enumerate(("north", "east", "down")):
        way.plot(time, position[:, k], color=CYCLE[k], label=axis)
        way.axhline(TARGET[k], color=CYCLE[k], linestyle=":", linewidth=1.0)
    way.set_ylabel("position, target dotted [m]", color=SOFT)
    for k in range(story.copter.num_rotors):
        u = story.flight.state.thrusts[0, :, k].numpy() / float(story.copter.max_thrusts[k])
        push.plot(time, 100.0 * u, color=CYCLE[k % len(CYCLE)], label=f"motor {k + 1}", lw=1.2)
    push.set_ylabel("thrust [% of greatest]", color=SOFT)
    for axes in (way, push):
        axes.set_xlim(0.0, float(time[-1]))
        axes.set_xlabel("time [s]", color=SOFT)
        axes.legend(frameon=False, fontsize=8, ncols=2)
    figure.suptitle(design.name.replace("_", " "), color=INK)
    figure.savefig(path, dpi=120)


def main(
    names: tuple[str, ...] = shipped_designs(),
    seconds: float = 8.0,
    out: str | None = None,
    fabricate: bool = False,
) -> dict[str, dict[str, float]]:
    """All stories; pictures and fabrication pages where ``out`` says."""
    numbers = {}
    for name in names:
        story = tell(name, seconds)
        numbers[name] = story.numbers
        if out is not None:
            draw(story, Path(out) / f"{name}.png")
        if out is not None and fabricate:
            from diffsim.copter.fabrication import plan, write_plan

            write_plan(plan(story.design), Path(out) / f"{name}_fabrication")
    return numbers


def table(numbers: dict[str, dict[str, float]]) -> str:
    """One column per design."""
    names = list(numbers)
    lines = [" " * 38 + "".join(f"{n[-12:]:>14s}" for n in names)]
    for key in numbers[names[0]]:
        lines.append(f"{key:38s}" + "".join(f"{numbers[n][key]:14.4g}" for n in names))
    return "\n".join(lines)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(shipped_designs()))
        parser.add_argument("--seconds", type=float, default=8.0, help="of flight")
        parser.add_argument("--out", metavar="FOLDER", help="write pictures here")
        parser.add_argument("--fabricate", action="store_true", help="and fabrication pages")
        args = parser.parse_args()
        chosen = tuple(args.names) or shipped_designs()
        print(table(main(chosen, args.seconds, args.out, args.fabricate)))
