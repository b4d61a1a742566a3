"""How much more can the pentacopter carry after co-optimization (thesis Table 3.1, Fig. 3-7)?

The flat pentacopter has the size and weight of Table 3.1. Its payload is optimized over rod
lengths, motor angles and spins, subject to hover; the shipped twin has the published outline of the
optimized one. All our numbers are predictions at full thrust, the thesis's payloads and overall
weights are flights.

Expected: +25.0 % overall weight, 0.004 % from the bound that no design exceeds (five motors at full
thrust instead of four), with motors tilted by 1.6 degrees; tilt alone gives +20.8 %. The thesis
predicted +15.8 % and flew +11.1 % with 10.6 degrees. Why they differ:

- Absolute weights: in the thesis's flight a loaded motor pulled 8.3 N, 71 % of what the bench
  measured. The signal was clamped, the battery sags, motors need a margin for control, propellers
  disturb each other; none of it is in the static limit.
- Gain: why the thesis predicted less is not known. On the sizes of Table 3.1 its Alg. 1, as built
  here, reaches 25.0 %, too (benchmarks/copter.py); a margin for control, or limits of size that it
  does not state, would explain a smaller one.
- Angles: many tilts balance five equal thrusts; ours stays near upright. Torque kept for control at
  the largest weight (0.5 N m in roll and pitch, 0.05 in yaw) asks for 8 degrees and gains 26.3 %
  over the flat design with the same torque kept.
- Size: the thesis does not say what bounded it. Ours keeps propellers 10 mm apart, and where torque
  is kept, lengths change by at most 0.3 mean arms: longer arms would always be better.

The clips under the motors, which co-design does not know, add 39 g and cost 0.15 % of the lift.
Running time: 9 CPU seconds.

    python examples/copter/table31.py --out runs/table31
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
from pathlib import Path

import torch

from diffsim.copter import GRAVITY, Multicopter, load_design, max_hover_weight, rotor_model
from diffsim.copter.codesign import Demands, Limits, SearchOptions, codesign

#: size x, y [mm]; weight, payload, overall weight [g]; largest motor angle [deg]
THESIS = {
    "unoptimized": (750.0, 420.0, 2322.0, 1047.0, 3369.0, 0.0),
    "optimized": (650.0, 670.0, 2353.0, 1392.0, 3745.0, 10.6),
}
PREDICTED_GAIN, MEASURED_GAIN, LIMIT = 15.8, 11.1, 25.0  # of the overall weight, thesis [%]
CLEARANCE = 0.01  # between propellers [m]
EXTENT = 0.3  # largest change of a length where torque is kept, in mean arm lengths
TORQUE = (0.5, 0.5, 0.05)  # kept for control at the largest weight, about x, y, z [N m]
ROWS = ("size x [mm]", "size y [mm]", "weight [g]", "max payload [g]", "max overall weight [g]",
        "max motor angle [deg]")  # fmt: skip


def row(copter: Multicopter, max_weight: float) -> tuple[float, ...]:
    """Table 3.1's numbers of a vehicle that lifts ``max_weight`` [N]."""
    span = 1e3 * (copter.positions.amax(0) - copter.positions.amin(0))
    tilt = torch.rad2deg(torch.arccos((-copter.directions[:, 2]).clamp(-1.0, 1.0))).max()
    mass, overall = 1e3 * float(copter.mass), 1e3 * max_weight / GRAVITY
    return (float(span[0]), float(span[1]), mass, overall - mass, overall, float(tilt))


def lifted(copter: Multicopter, torque: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> float:
    """Largest weight that hovers with a torque kept in every combination of signs [N]."""
    return float(max_hover_weight(copter, torque=torque))


def main(starts: int = 4, out: str | None = None) -> dict[str, float]:
    """Optimize, compare, and plan the fabrication of the optimum where ``out`` says."""
    torch.set_num_threads(1)
    design = load_design("pentacopter")
    flat = design.multicopter().detach()
    twin = load_design("pentacopter_payload").multicopter().detach()
    tilted = codesign(
        design,
        "payload",
        limits=Limits(free=("directions", "attitude")),
        search=SearchOptions(num_starts=starts),
    )
    best = codesign(
        design,
        "payload",
        limits=Limits(clearance=CLEARANCE),
        search=SearchOptions(num_starts=starts),
    )
    ready = codesign(
        design,
        "payload",
        limits=Limits(clearance=CLEARANCE, extent=EXTENT),
        demands=Demands(authority=TORQUE),
        search=SearchOptions(num_starts=starts),
    )
    columns = {
        "thesis, flat": THESIS["unoptimized"],
        "ours, flat": row(flat, lifted(flat)),
        "thesis, optimized": THESIS["optimized"],
        "ours, optimized": row(best.vehicle, best.max_weight),
        "ours, torque kept": row(ready.vehicle, ready.max_weight),
        "shipped twin": row(twin, lifted(twin)),
    }
    print(" " * 24 + "".join(f"{name:>19s}" for name in columns))
    for k, label in enumerate(ROWS):
        print(f"{label:24s}" + "".join(f"{values[k]:19.1f}" for values in columns.values()))
    start = lifted(flat)
    in_flight = THESIS["unoptimized"][4] * 1e-3 * GRAVITY / 4.0
    numbers = {
        "gain [%]": 100.0 * (best.max_weight / start - 1.0),
        "gain of tilt alone [%]": 100.0 * (tilted.max_weight / start - 1.0),
        "gain of the shipped twin [%]": 100.0 * (lifted(twin) / start - 1.0),
        "gain with torque kept [%]": 100.0 * (ready.max_weight / lifted(flat, TORQUE) - 1.0),
        "gap to the bound [%]": 100.0 * best.gap,
        "thrust per loaded motor in the thesis's flight [N]": in_flight,
        "the same, share of the bench's greatest [%]": 100.0
        * in_flight
        / float(rotor_model("kde2814_14in").max_thrust),
        "seconds per start": sum(s.seconds for s in best.starts) / len(best.starts),
    }
    print(
        f"thesis: gain {PREDICTED_GAIN} % predicted, {MEASURED_GAIN} % flown, "
        f"below {LIMIT:.0f} % for any design"
    )
    if out is not None:
        from diffsim.copter.fabrication import plan
        from diffsim.viz.fabrication_page import write_fabrication

        built = plan(design, best.s, best.directions, best.spins)
        print(f"fabrication plan: {write_fabrication(built, Path(out) / 'fabrication')}")
        vehicle = built.design.multicopter()
        numbers["largest overall weight as built, with clips [g]"] = 1e3 * lifted(vehicle) / GRAVITY
        numbers["weight as built, with clips [g]"] = 1e3 * float(vehicle.mass)
    return numbers


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--starts", type=int, default=4, help="of each co-design")
        parser.add_argument("--out", metavar="FOLDER", help="fabrication plan of the optimum")
        args = parser.parse_args()
        for name, value in main(args.starts, args.out).items():
            print(f"{name:52s} {value:.4g}")
