"""Drawn cases: data sheets that are off, and first sentences that are amiss."""

import numpy as np
import pytest
import torch

from labs.rates.sentences import amiss, write_sentences
from labs.rates.sheets import held_sheets, true_base
from labs.systems import setup_of
from labs.virtual import NetworkLab
from tests.labs.short_copter import ShortCopterLab


@pytest.mark.parametrize("lab", [ShortCopterLab, NetworkLab])
def test_true_values_are_those_that_made_the_record(lab):
    """At the true base parameters the model is near a record without noise, else far from it."""
    made = lab().case(11, decoys=("far_prior",), noise=0.0)
    study, base = made.study, true_base(lab.base, made.truth)
    model, run = setup_of(study).model, study.runs[0]
    q = model.at_prior()
    for i, p in enumerate(model.base):
        if "@" not in p.name:
            true = base[p.name]
            q[i] = np.log(true / p.value) / p.sd if p.log else (true - p.value) / p.sd
    sd = np.array([c.sd for c in study.channels])

    def misfit(at):
        with torch.no_grad():
            off = (model.predict(run, at).numpy() - run.measured) / sd
        return float(np.sqrt(np.mean(off**2)))

    found, plain = misfit(q), misfit(model.at_prior())
    assert found < 0.25 * plain, (found, plain)


def test_a_finding_is_held_against_the_truth():
    base = {"mass_gain": 1.06}
    said = {"mass_gain": [1.059, 1.05, 1.07], "color": [1.0, 0.9, 1.1]}
    held = held_sheets(base, said)
    assert held["mass_gain"]["inside"] and held["mass_gain"]["true"] == 1.06
    assert not held["color"]["inside"] and held["color"]["true"] is None
    assert not held_sheets(base, {"mass_gain": [1.1, 1.09, 1.11]})["mass_gain"]["inside"]


GOOD = "Dry friction is missing: error on unseen runs 2 to 1 mm, noise 0.9 mm."
FACTS = {"domain": "toy", "index": 3, "hidden": "dry_friction", "lambda": 12.0, "outcome": "right"}


def case(**changes):
    return {**FACTS, "headline": f"{GOOD} Not certain: this is a first answer.", **changes}


def test_what_is_wrong_long_or_code_is_amiss(tmp_path):
    cases = {
        "": case(),
        "missed": case(outcome="missed"),
        "long": case(headline="a " * 26 + "."),
        "code name": case(headline="dry_friction is missing."),
        "none": case(headline=""),
    }
    for why, row in cases.items():
        assert ", ".join(amiss(row)) == why
    text = write_sentences(list(cases.values()), tmp_path / "said.md").read_text()
    assert text.count("\n| toy_0003 |") == 5 and GOOD in text and "Not certain" not in text
    assert text.rstrip().endswith("1 of 5 are true and have at most 25 words.")
