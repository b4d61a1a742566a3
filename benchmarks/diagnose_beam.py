"""Diagnosis of the recorded silicone beam, from a coarse look to the real one, with a log.

python benchmarks/diagnose_beam.py runs/beam --until 0.8 --cells 4 2 2 --effects loss_factor
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

from diffsim.data.importers import import_study
from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.gain import gain
from diffsim.identify import SearchSettings
from diffsim.systems.published.silicone_beam import setup


def main() -> None:
    """Diagnose, print what happens, save report.json and extended_model.yaml."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out")
    parser.add_argument("--until", type=float, default=1.0, help="seconds after release")
    parser.add_argument("--cells", type=int, nargs=3, default=(8, 3, 3))
    parser.add_argument("--dt", type=float, default=5e-3)
    parser.add_argument("--effects", nargs="*", help="names; all by default")
    parser.add_argument("--max-effects", type=int, default=3)
    parser.add_argument("--with-weight", action="store_true", help="the loaded runs, too")
    parser.add_argument("--swap", action="store_true", help="fit second recordings, hold out first")
    parser.add_argument("--accept-numerics", action="store_true")
    given = parser.parse_args()
    made = setup(
        import_study("silicone_beam"),
        cells=given.cells,
        dt_s=given.dt,
        until_s=given.until,
        search=SearchSettings(max_effects=given.max_effects, num_refits=2, max_rounds=4),
        with_weight=given.with_weight,
        accept_numerics=given.accept_numerics,
    )
    assert made.study is not None  # this setup cuts its own window
    study = swapped(made.study) if given.swap else made.study
    effects = [e for e in made.effects if not given.effects or e.name in given.effects]
    report = diagnose(
        study,
        made.model,
        effects,
        seed=0,
        unknowns=made.unknowns,
        bank=made.bank,
        settings=made.settings,
        progress=_show,
    )
    report.save(given.out)
    print(report.verdict, *report.sentences, sep="\n")
    for row in report.table:
        print(row.effect, row.status, dict(row.size), dict(row.sd), row.nats, row.gain, row.share)
    if report.null is not None and report.best is not None:
        for run in report.study.test_runs:
            print(f"held-out {run.name}: {gain([run], report.null, report.best, seed=0)}")
    print(f"{time.process_time():.0f} s of processor time")


def swapped(study: Study) -> Study:
    """What was fitted is held out, and the reverse."""
    other = {"fit": "test", "test": "fit"}
    return replace(study, runs=tuple(replace(r, use=other[r.use]) for r in study.runs))


def _show(stage: str, fraction: float, message: str) -> None:
    print(f"{time.process_time():.0f} s  {stage}: {message}", flush=True)


if __name__ == "__main__":
    main()
