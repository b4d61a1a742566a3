"""Are these recordings fit for a diagnosis, and what would be wrong with them?

A cart on a spring is pushed in three ways and filmed. The study is written, read back and checked.
Then the run that was held out is dropped: no claim about it could be tested.

Expected: no error in the first, at least one in the second. Running time: 2 s.

    python examples/data/check_study.py  # for your own: diffsim diagnose check STUDY
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import tempfile
from dataclasses import replace

import numpy as np
from scipy import signal

from diffsim.data import Channel, Problem, Run, Study, check_study, load_study, save_study

MASS, DAMPING, STIFFNESS, NOISE = 1.0, 0.8, 40.0, 2e-4  # [kg], [N s/m], [N/m], [m]


def recorded(seed: int) -> Study:
    """Places of the cart under three forces, two of them repeated; the sine is held out."""
    time, rng = np.arange(300) / 100.0, np.random.default_rng(seed)
    cart = signal.lti([1.0], [MASS, DAMPING, STIFFNESS])
    forces = {
        "push": np.where(time < 1.0, 2.0, 0.0),
        "chirp": signal.chirp(time, 0.5, 3.0, 4.0),
        "sine": np.sin(2.0 * np.pi * time),
    }
    runs = []
    for name, force in forces.items():
        for repeat in ("a",) if name == "sine" else ("a", "b"):
            place = signal.lsim(cart, force, time)[1] + NOISE * rng.standard_normal(len(time))
            use = "test" if name == "sine" else "fit"
            run = Run(f"{name}_{repeat}", time, place[:, None], {"force_N": force}, name)
            runs.append(replace(run, order=len(runs), use=use))
    channel = Channel("place_m", "m", "position", NOISE)
    return Study("cart", "rigid_body", (channel,), tuple(runs), {})


def main(seed: int = 0) -> dict[str, list[Problem]]:
    """Problems of the whole study, and of the one without held-out runs."""
    with tempfile.TemporaryDirectory() as folder:
        study = load_study(save_study(recorded(seed), folder))
    print(f"{study.name}: {len(study.channels)} channels, {len(study.runs)} runs")
    return {
        "as recorded": check_study(study),
        "nothing held out": check_study(replace(study, runs=study.fit_runs)),
    }


if __name__ == "__main__":
    with interruptible():
        for name, problems in main().items():
            print(f"{name}: {len(problems)} problems")
            for problem in problems:
                print(f"  {problem}")
