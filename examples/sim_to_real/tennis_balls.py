"""Which camera, throw and contact explain a video of two colliding tennis balls?

The thesis's real-to-sim experiment (4.1.6, Fig. 4-18): two balls of 320 tetrahedra roll on an exact
table and push each other through their centers. Camera, first places and velocities, spin,
stiffness and friction are found from the pixels of the balls' centers and of eight clicked corners:
the camera from the clicks, the throw from the first frames, random samples of the rest, then
Gauss-Newton through the simulation (--adjoint: L-BFGS by its gradient). The last third of the
frames judges. The rigid balls of the diagnosis are fitted beside.

With --video the tracks come from a video file (OpenCV), with corners clicked in its first picture
in a CSV beside it; film_tennis_balls.py makes such a video of the simulation itself.

Expected: centers 4.8 px off at the best sample, 3.6 px after the full fit (79 s of CPU time) and
19.6 px on the held-out frames; rigid balls with three more causes 0.7 and 4.1 px. The soft model
lacks what they have: friction between the balls that feels spin, and losses in rolling that are not
those of facets.

    python examples/sim_to_real/tennis_balls.py --quick
    python examples/sim_to_real/film_tennis_balls.py runs/film.avi
    python examples/sim_to_real/tennis_balls.py --quick --video runs/film.avi
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core import show_progress
from diffsim.core.files import write_json_atomic
from diffsim.core.paths import data_folder
from diffsim.data import Channel, Run, Study
from diffsim.identify import Jacobian, Problem, WhiteNoise, fit
from labs.balls import MOTION, SoftBallModel
from labs.balls.figures import ShownBall, misfits, overlay, recording, simulated, strip
from labs.balls.film import view_of
from labs.balls.fits import setup, soft_model
from labs.balls.multi_start import descend, random_starts
from labs.balls.recordings import ball_tracks_study, ball_video_study

Array = NDArray[np.float64]
# Seen before the impact, and so not drawn at random; the numbers are at the priors' centers.
SEEN = ("focal", *(f"{n}_{a}" for n in ("turn", "shift") for a in "xyz"))
SEEN += ("x0", "y0", "x1", "y1", "vx1", "vy1")
PIXEL_SD = 1.0  # one weight for all pixels: the loss is in pixels, as in the thesis
JACOBIAN = Jacobian(step=0.03)  # wide differences: facets make the motion rough
FIRST_FRAME = {"tennis_balls": 150}
DIAMETER, MASS = 0.06858, 0.0577  # [m], [kg]


@dataclass(frozen=True)
class Effort:
    """How much is tried."""

    starts: int  # random samples
    rounds: int  # of Gauss-Newton; progress is kept after each
    evaluations: int  # in each round


QUICK, FULL = Effort(8, 1, 6), Effort(24, 3, 5)


@dataclass(frozen=True, eq=False)
class Found:
    """Standardized coordinates before and after, and ½ |r|² + ½ |x|² along the way."""

    before: Array
    after: Array
    random_costs: Array
    costs: tuple[float, ...]


def find(
    study: Study, model: SoftBallModel, effort: Effort, seed: int, adjoint: bool, kept: Path
) -> Found:
    """Random samples of the motion, then a descent from the best.

    Args:
        study: Its fit runs are used.
        model: The simulator.
        effort: How much is tried.
        seed: Of the samples.
        adjoint: L-BFGS with the gradient through the simulation, instead of Gauss-Newton with
            differences of simulations.
        kept: File for the coordinates after each round; if it is there, the rounds go on from it.
    """
    channels = equal(study)
    problem = Problem(model, study.fit_runs, WhiteNoise(channels), jacobian=JACOBIAN)
    with show_progress(total=effort.starts, desc="random starts") as bar:
        starts = random_starts(
            problem, effort.starts, seed=seed, fixed=SEEN, report=lambda cost: bar.update()
        )
    x, costs = starts.x[0], [float(starts.cost[0])]
    if kept.is_file():
        before = json.loads(kept.read_text(encoding="utf-8"))
        x, costs = np.array(before["x"]), before["costs"]
    if adjoint:
        budget = 15 * effort.rounds * effort.evaluations  # about as long as the differences take
        with show_progress(total=budget, desc="adjoint descent") as bar:
            down = descend(problem, x, max_evaluations=budget, report=lambda cost: bar.update())
        return Found(starts.x[0], down.x, starts.cost, down.cost)
    for number in range(len(costs) - 1, effort.rounds):
        with show_progress(
            desc=f"Gauss-Newton, round {number + 1} of {effort.rounds}", unit="run"
        ) as bar:
            model.report = bar.update
            found = fit(
                model,
                study.fit_runs,
                channels,
                start=x,
                jacobian=JACOBIAN,
                max_evaluations=effort.evaluations,
            )
        x = found.x
        costs.append(0.5 * (found.chi2 + found.prior))
        write_json_atomic(kept, {"x": x, "costs": costs})
        print(f"cost {costs[-1]:.1f}")
        if found.converged or costs[-1] > 0.995 * costs[-2]:
            break
    return Found(starts.x[0], x, starts.cost, tuple(costs))


def equal(study: Study) -> list[Channel]:
    """The channels, every pixel of equal weight."""
    return [replace(c, sd=PIXEL_SD) for c in study.channels]


def distances(run: Run, seen: Array, columns: Sequence[int]) -> Array:
    """How far predicted pixels lie from measured ones, (num_samples, len(columns) / 2) [px]."""
    off = (seen - run.measured)[:, columns].reshape(len(seen), -1, 2)
    return np.linalg.norm(off, axis=-1)


def judge(study: Study, predict: Any) -> dict[str, float]:
    """Root mean square distances [px] of the balls' centers, and of the corners."""
    out = {}
    for run in study.runs:
        with torch.no_grad():
            seen = predict(run).numpy()
        out["fitted_px" if run.use == "fit" else "held_out_px"] = rms(
            distances(run, seen, [0, 1, 2, 3])
        )
        if run.use == "fit":
            out["corners_px"] = rms(distances(run, seen, [4, 5]))
    return out


def rms(values: Array) -> float:
    """Root mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def rigid(study: Study) -> dict[str, dict[str, float]]:
    """The diagnosis's rigid balls on the same pixels: as published there, plain and extended."""
    prepared = setup(study)
    model, known = prepared.model, {e.name: e for e in prepared.effects}
    causes = [known[n] for n in ("sliding_friction", "ball_friction", "rolling_resistance")]
    out = {}
    for name, effects in (("rigid, frictionless", []), ("rigid, three causes", causes)):
        found = fit(model, study.fit_runs, equal(study), effects=effects)
        x = torch.from_numpy(found.x)
        sizes = found.problem.sizes_at(x)
        q = x[: found.problem.num_base]
        out[name] = judge(study, lambda run, q=q, sizes=sizes: model.predict(run, q, sizes))
    return out


def whole(study: Study) -> Study:
    """All frames fitted, none held out, as the thesis did."""
    if len(study.runs) == 1:
        return study
    first, last = study.runs
    zeros = {k: np.concatenate([v, last.command[k]]) for k, v in first.command.items()}
    run = replace(
        first,
        time_s=np.concatenate([first.time_s, last.time_s]),
        measured=np.concatenate([first.measured, last.measured]),
        command=zeros,
    )
    return replace(study, runs=(run,))


def write_pictures(study: Study, model: SoftBallModel, found: Found, out: Path) -> None:
    """Overlay, strip and errors as PNG, the simulated balls as a rerun recording."""
    full = whole(study).runs[0]
    frames = np.rint(full.time_s / model.balls.frame_s).astype(int)
    seen = np.full((frames[-1] + 1, 2, 2), np.nan)
    seen[frames] = full.measured[:, :4].reshape(-1, 2, 2)
    view = view_of(model, found.after)
    size_px = (view.width_px, view.height_px)
    rows = [
        simulated(name, model, x, seen)
        for name, x in (("before", found.before), ("after", found.after))
    ]
    cut = round(float(study.fit_runs[0].time_s[-1]) / model.balls.frame_s) + 1
    first = FIRST_FRAME.get(study.name, 0)
    columns = [round(share * (len(seen) - 1)) for share in (0.0, 0.2, 0.33, 0.45, 0.65, 1.0)]
    pictures = {
        "overlay": overlay([*rows, ShownBall("as tracked", None, seen)], seen, size_px, cut),
        "strip": strip(rows, seen, size_px, columns, first),
        "errors": misfits(rows, seen, first, cut),
    }
    for name, figure in pictures.items():
        figure.savefig(out / f"{name}.png", dpi=110)
    recording(model, {"before": found.before, "after": found.after}, len(seen), out / "balls.rrd")


def compare_with_truth(video: Path, values: dict[str, float]) -> dict[str, list[float]]:
    """Found and true numbers of a rendered video, where its truth lies beside it."""
    path = beside(video, "truth.json")
    if not path.is_file():
        return {}
    truth = json.loads(path.read_text(encoding="utf-8"))["values"]
    return {n: [found, truth[n]] for n, found in values.items() if n in MOTION or n == "focal"}


def beside(video: Path, what: str) -> Path:
    """film.avi -> film_corners.csv"""
    return video.with_name(f"{video.stem}_{what}")


# Story ------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> dict[str, Any] | None:
    """Identify and judge; None where there is no recording."""
    args = arguments().parse_args(argv)
    began = time.process_time()
    if args.video is not None:
        corners = args.corners or beside(args.video, "corners.csv")
        study = ball_video_study(args.video, corners, diameter_m=DIAMETER, mass_kg=MASS)
    elif (folder := data_folder()) and (folder / "tennis_balls/tracks.csv").is_file():
        study = ball_tracks_study(folder / "tennis_balls")
    else:
        print("no recording: set DIFFSIM_DATA to the folder of the measured data, or give --video")
        return None
    fitted = whole(study) if args.all_frames else study
    model = soft_model(fitted, steps=args.steps, subdivisions=args.subdivisions, radial=args.radial)
    print(model.balls.body)
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "rounds.json"
    if not args.resume:
        kept.unlink(missing_ok=True)
    effort = QUICK if args.quick else FULL
    if args.evaluations is not None:
        effort = replace(effort, evaluations=args.evaluations)
    found = find(fitted, model, effort, args.seed, args.adjoint, kept)
    values = {n: float(v) for n, v in model.values_at(found.after).items()}
    result: dict[str, Any] = {
        "before": judge(fitted, lambda run: model.predict(run, torch.from_numpy(found.before))),
        "after": judge(fitted, lambda run: model.predict(run, torch.from_numpy(found.after))),
        "values": values,
        "costs": list(found.costs),
        "cost_over_mean_random": min(found.costs) / float(np.mean(found.random_costs)),
    }
    if args.video is None:
        result |= rigid(fitted)
    else:
        result["found_and_true"] = compare_with_truth(args.video, values)
    result["cpu_s"] = time.process_time() - began
    for name, entry in result.items():
        if isinstance(entry, dict):
            print(f"{name}: " + ", ".join(f"{k} {_number(v)}" for k, v in entry.items()))
    print(f"{result['cpu_s']:.0f} s of CPU time")
    write_json_atomic(args.out / "result.json", result)
    write_pictures(study, model, found, args.out)
    print(f"pictures: {args.out}")
    return result


def _number(value: Any) -> str:
    if isinstance(value, list):
        return f"{value[0]:.4g} (true {value[1]:.4g})"
    return f"{value:.4g}"


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--quick", action="store_true", help="fewer starts and steps of the descent"
    )
    parser.add_argument("--video", type=Path, metavar="FILE", help="track this instead")
    parser.add_argument("--corners", type=Path, metavar="CSV", help="default: FILE_corners.csv")
    parser.add_argument("--all-frames", action="store_true", help="hold nothing out, as the thesis")
    parser.add_argument("--radial", action="store_true", help="fit the lens's distortion too")
    parser.add_argument("--evaluations", type=int, metavar="N", help="of each round")
    parser.add_argument("--adjoint", action="store_true", help="L-BFGS by the adjoint's gradient")
    parser.add_argument("--resume", action="store_true", help="go on from the rounds kept in --out")
    parser.add_argument("--steps", type=int, default=3, help="per frame (thesis and default: 3)")
    parser.add_argument("--subdivisions", type=int, default=2, help="2: 320 tetrahedra a ball")
    parser.add_argument("--seed", type=int, default=0, help="of the random starts")
    parser.add_argument("--out", type=Path, default=Path("runs/tennis_balls"))
    return parser


if __name__ == "__main__":
    with interruptible():
        main()
