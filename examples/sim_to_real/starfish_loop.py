"""Does a robot swim faster when simulation and hardware take turns?

The loop of thesis Alg. 7 on the starfish, with a virtual laboratory as hardware: execute a
command, identify E, w and the control points of C_d and C_t from four markers, optimize the
command, execute it again. The laboratory is a robot of rods with its own water, rail, servo and
camera, and shares no code with the model. Ends with Table 5.2 and Figs. 5-6 to 5-9 of ours, and
with the same identification on the recordings of the real robot.

Expected: from -0.02 cm/s (hand-made sine) to 1.20, 1.25 and 1.24 cm/s, predicted to 0.11 cm/s in
the end; 240 s of processor time, and 40 s for the real robot (docs/sim_to_real.md). Every
experiment is saved at once; after an interruption ``--resume`` goes on without repeating one.

    python examples/sim_to_real/starfish_loop.py --out runs/starfish_loop
    python examples/sim_to_real/starfish_loop.py --rig my_rig    # your hardware, through files
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import time
from dataclasses import replace
from pathlib import Path

from labs.loop import (
    AwaitingRecordingError,
    FileHardware,
    FitSettings,
    Hardware,
    Limits,
    LoopSettings,
    Starfish,
    TrajectorySettings,
    VirtualLaboratory,
    import_starfish,
    on_real_recording,
    sim_to_real,
    sinusoid,
)

FULL = LoopSettings(
    max_iterations=4,
    fit=FitSettings(duration_s=3.0, max_evaluations=12),
    trajectory=TrajectorySettings(max_evaluations=12),
)
QUICK = LoopSettings(
    max_iterations=1,
    fit=FitSettings(duration_s=2.0, max_evaluations=4),
    trajectory=TrajectorySettings(periods=1, max_evaluations=4),
)

REAL = FitSettings(duration_s=3.0, method="gauss_newton", max_evaluations=8)


def main(
    out: str = "runs/starfish_loop",
    *,
    quick: bool = False,
    resume: bool = False,
    rig: str | None = None,
    real: bool = True,
    seed: int = 0,
    max_iterations: int | None = None,
) -> dict[str, float] | None:
    """Run the loop and write its report; None while a rig's recording is awaited."""
    settings = QUICK if quick else FULL
    if max_iterations is not None:
        settings = replace(settings, max_iterations=max_iterations)
    limits = Limits()
    duration_s = 6.0 if quick else 12.0
    hardware: Hardware = VirtualLaboratory(seed=seed, duration_s=duration_s, limits=limits)
    if rig is not None:
        hardware = FileHardware(folder=Path(rig), duration_s=duration_s, limits=limits)
    model, begin = Starfish(), time.process_time()
    try:
        result = sim_to_real(model, hardware, sinusoid(limits=limits), out, settings, resume=resume)
    except AwaitingRecordingError as awaited:
        print(awaited)
        return None
    loop_s = time.process_time() - begin
    found = _real(model, QUICK.fit if quick else REAL) if real else None
    # matplotlib and jinja2 are only needed from here on
    from labs.loop.report import write_loop

    page = write_loop(result, model, out, fit_s=settings.fit.duration_s, real=found)
    print(f"report: {page}")
    numbers = {f"v_r_{i.idx}_cm_s": 1e2 * i.speed_measured for i in result.iterations}
    numbers |= {f"v_s_{i.idx}_cm_s": 1e2 * i.speed_simulated for i in result.iterations}
    return {**numbers, "cpu_s": loop_s}


def _real(model: Starfish, settings: FitSettings) -> dict | None:
    try:
        study = import_starfish()
    except FileNotFoundError as missing:
        print(f"no recordings of the real starfish, that part is left out: {missing}")
        return None
    return on_real_recording(study, model, settings)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--out", default="runs/starfish_loop", help="folder of the loop")
        parser.add_argument("--quick", action="store_true", help="one short iteration")
        parser.add_argument("--resume", action="store_true", help="go on with an interrupted loop")
        parser.add_argument("--rig", metavar="FOLDER", help="hardware of yours, through files")
        parser.add_argument("--no-real", action="store_true", help="leave the real recordings out")
        parser.add_argument("--max-iterations", type=int, help="after bl-ctrl; 4 by default")
        parser.add_argument("--seed", type=int, default=0, help="of the laboratory's scatter")
        args = parser.parse_args()
        found = main(
            args.out,
            quick=args.quick,
            resume=args.resume,
            rig=args.rig,
            real=not args.no_real,
            seed=args.seed,
            max_iterations=args.max_iterations,
        )
        for name, value in (found or {}).items():
            print(f"{name:16s} {value:.4g}")
