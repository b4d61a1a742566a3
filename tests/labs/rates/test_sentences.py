"""First sentences of drawn cases: what is counted as amiss."""

from labs.rates.sentences import amiss, write_sentences

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
