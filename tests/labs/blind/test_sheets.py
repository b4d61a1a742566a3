"""Data sheets that are off by a draw: what an answer says of them is held against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from labs.blind.score import score_answer
from labs.blind.sealed import BENCHES, study_of
from labs.blind.sheets import held_sheets, true_value
from labs.blind.table import figures
from labs.systems import setup_of
from tests.diagnose import toy
from tests.labs.short_copter import ShortCopterLab


@pytest.mark.parametrize(
    ("bench", "near"),
    [
        (replace(BENCHES["copter"], lab=ShortCopterLab), 0.25),
        (BENCHES["network"], 0.25),
    ],
    ids=["copter", "network"],
)
def test_true_values_are_those_that_made_the_record(bench, near):
    """At the true base parameters the model is near a record without noise, else far from it."""
    label = {"seed": 11, "effects": {}, "decoys": ["far_prior"]}
    study, truth = study_of(bench, label, noise=0.0)
    model, run = setup_of(study).model, study.runs[0]
    q = model.at_prior()
    for i, p in enumerate(model.base):
        if "@" not in p.name:
            true = true_value(bench, truth, p.name)
            assert true is not None, p.name
            q[i] = np.log(true / p.value) / p.sd if p.log else (true - p.value) / p.sd
    sd = np.array([c.sd for c in study.channels])

    def misfit(at):
        with torch.no_grad():
            off = (model.predict(run, at).numpy() - run.measured) / sd
        return float(np.sqrt(np.mean(off**2)))

    found, plain = misfit(q), misfit(model.at_prior())
    assert found < near * plain, (found, plain)
    assert true_value(bench, truth, "nobody") is None


def case(kind, verdict, sheets=None):
    label = {"kind": kind, "effects": {}, "decoys": [], "options": {}}
    answer = {"verdict": verdict, "named": [], "rivals": [], "intervals": {}}
    return score_answer(label, answer, toy.LIBRARY, sheets)


def test_a_data_sheet_called_off_is_right_where_its_interval_holds_the_truth():
    bench, truth = BENCHES["copter"], {"base": {"mass": 1.4 * 1.06}}
    inside = held_sheets(bench, truth, {"mass_gain": [1.059, 1.05, 1.07]})
    outside = held_sheets(bench, truth, {"mass_gain": [1.1, 1.09, 1.11]})
    unknown = held_sheets(bench, truth, {"color": [1.0, 0.9, 1.1]})
    assert inside["mass_gain"]["true"] == pytest.approx(1.06)
    for kind in ("null", "decoy"):
        scores = [case(kind, "data_sheet", s) for s in (inside, outside, unknown, None)]
        assert [s["right"] for s in scores] == [True, False, False, False]
        found = {row["what"]: row for row in figures(scores)}
        assert found["nulls and decoys with a name or unknown"]["hits"] == 3
        assert found["nulls and decoys, a data sheet called off"]["hits"] == 4
        assert not case(kind, "named", inside)["right"]
    # it names no cause: where one is hidden it is neither right nor a wrong name
    label = {"kind": "single", "effects": {"drag": [0.1]}, "decoys": [], "options": {}}
    answer = {"verdict": "data_sheet", "named": [], "rivals": [], "intervals": {}}
    found = score_answer(label, answer, toy.LIBRARY, inside)
    assert not found["right"] and not found["wrong_alone"]
