"""Diagnose one sealed case: ``python -m labs.blind.case STUDY RESULT``.

Runs in a process of its own that is given the folder of the data and nothing else.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from diffsim.cli.arguments import FULL, QUICK
from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core import interruptible
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_json_atomic
from diffsim.data.study_file import load_study
from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.say.report import Report
from diffsim.identify.effect import Effect
from diffsim.identify.model import Numerics, SimModel
from labs.blind.sealed import OPTIONS_FILE

TWIN = "{}_again"


def twin(of: Effect) -> Effect:
    """An effect under a second name: no data can tell the two apart."""
    return replace(of, name=TWIN.format(of.name), also_looks_like=())


class CoarseModel(SimModel):
    """A model with coarser numerical settings as its own.

    Args:
        inner: The model; must honor ``Numerics``.
        factors: By field of ``Numerics``.
    """

    def __init__(self, inner: SimModel, factors: Mapping[str, float]):
        super().__init__(inner.build, inner.base, inner.name, batched=inner.batched)
        self.inner, self.factors, self.simulations = inner, dict(factors), inner.simulations

    def _scaled(self, numerics: Numerics | None) -> Numerics:
        own = numerics or Numerics()
        return replace(own, **{name: f * getattr(own, name) for name, f in self.factors.items()})

    def predict(
        self, run: Any, q: Tensor, sizes: Any = None, numerics: Numerics | None = None
    ) -> Tensor:
        """As the model, coarser."""
        return self.inner.predict(run, q, sizes, self._scaled(numerics))

    def predict_many(
        self, run: Any, q: Tensor, sizes: Any = None, numerics: Numerics | None = None
    ) -> Tensor:
        """As the model, coarser."""
        return self.inner.predict_many(run, q, sizes, self._scaled(numerics))

    def prepared_at(self, q: Tensor) -> SimModel:
        """The model prepared there, coarser."""
        inner = self.inner.prepared_at(q)
        return self if inner is self.inner else CoarseModel(inner, self.factors)


def case_inputs(
    folder: Path, *, quick: bool = False, setup_file: Path | None = None, workers: int = 1
) -> Inputs:
    """Study and setup of a sealed case, with the library and settings that it prescribes."""
    options = json.loads((folder / OPTIONS_FILE).read_text(encoding="utf-8"))
    inputs = inputs_of(
        load_study(folder),
        seed=0,
        setup_file=setup_file,
        budget=QUICK if quick else FULL,
        workers=workers,
    )
    setup = inputs.setup
    # names of a laboratory's effect with several components: "weak_rotor" is weak_rotor_1, ...
    left_out = tuple(options.get("without", ()))
    effects = [e for e in setup.effects if not _is_or_part(e.name, left_out)]
    effects += [twin(e) for e in effects if e.name in options.get("twins", ())]
    model = CoarseModel(setup.model, options["coarse"]) if "coarse" in options else setup.model
    return replace(inputs, setup=replace(setup, effects=tuple(effects), model=model))


def _is_or_part(name: str, names: Sequence[str]) -> bool:
    return name in names or name.rstrip("0123456789").rstrip("_") in names


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--setup", type=Path)
    args = parser.parse_args(arguments)
    start = time.process_time()
    inputs = case_inputs(args.study, quick=args.quick, setup_file=args.setup)
    setup = inputs.setup
    try:
        report = diagnose(
            inputs.study,
            setup.model,
            setup.effects,
            seed=inputs.seed,
            unknowns=setup.unknowns,
            bank=setup.bank,
            settings=setup.settings,
        )
        content = answer_of(report)
    except (DiffsimError, ValueError) as error:  # counts as a wrong answer, with its reason
        content = {"verdict": "failed", "error": f"{type(error).__name__}: {error}"}
    write_json_atomic(args.result, content | {"cpu_s": time.process_time() - start})


def answer_of(report: Report) -> dict[str, Any]:
    """What is scored."""
    return {
        "verdict": report.verdict,
        "sentences": list(report.sentences),
        "named": sorted(report.named),
        "rivals": [sorted(r) for r in report.rivals],
        "sizes": {row.effect: {"size": row.size, "sd": row.sd} for row in report.table},
        "intervals": {
            row.name: {c: [s.value, s.low, s.high] for c, s in row.size.items()}
            for row in report.causes
        },
        "sheets": {row.name: [row.value, row.low, row.high] for row in report.base if row.finding},
        "cannot_see": dict(report.cannot_see),
        "failed_gates": [g.name for g in report.gates if not g.passed],
        "gain": None if report.gain is None else [report.gain.value, report.gain.status],
        "chi2": [report.chi2_null, report.chi2_best, report.num_samples],
        "hypotheses": [
            [list(h.effects), h.unknown, round(h.nats, 2)] for h in report.hypotheses[:6]
        ],
    }


if __name__ == "__main__":
    with interruptible():
        main()
