"""Rates from a Python function: traced to formulas, and only where the user says so."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.cli.diagnose_inputs import own_setup
from diffsim.core.expression import parse_expression
from diffsim.systems.ode.traced import LONGEST, formulas_of, with_function
from diffsim.systems.registry import description_of, setup_of
from tests.systems.toy_cart import cart_study, described

STUDY = cart_study(noise=1e-12)
CODE = """
def spring(x, k):
    return k * x


def rates(x, v, force, m, c, k):
    return {"x": v, "v": (force - c * v - spring(x, k)) / m}
"""


def values_of(function, **given):
    rates, named = formulas_of(function, "f")
    known = {k: torch.tensor(v, dtype=torch.float64) for k, v in given.items()}
    for name, text in named.items():
        known[name] = parse_expression(text)(known)
    return {k: float(parse_expression(text)(known)) for k, text in rates.items()}


def everyday(a, b):
    total = sum(abs(a) ** k / math.factorial(k) for k in range(4))
    both = np.where(a > b, np.minimum(a, 2.0), torch.sin(b)) - -a
    return {
        "x": total + np.arctan2(a, b) + np.clip(a, -0.1, 0.1) + np.float64(2.0) * b,
        "y": both / (1.0 + np.exp(-b)) + torch.clamp(b, 0.0, 0.5),
        "z": 3,
    }


@pytest.mark.reference
@pytest.mark.parametrize(("a", "b"), [(0.7, -0.3), (-1.2, 0.4), (3.0, 1.0)])
def test_what_is_written_is_what_the_function_computes(a, b):
    found = values_of(everyday, a=a, b=b)
    total = 1 + abs(a) + abs(a) ** 2 / 2 + abs(a) ** 3 / 6
    both = (min(a, 2.0) if a > b else math.sin(b)) + a
    want = {
        "x": total + math.atan2(a, b) + np.clip(a, -0.1, 0.1) + 2.0 * b,
        "y": both / (1.0 + math.exp(-b)) + min(max(b, 0.0), 0.5),
        "z": 3.0,
    }
    assert found == pytest.approx(want, rel=1e-14)


def test_long_formulas_are_cut_into_named_parts():
    def logistic(x):
        for _ in range(30):
            x = 3.5 * x * (1.0 - x)
        return {"x": x}

    _, named = formulas_of(logistic, "f")
    assert len(named) > 5 and max(map(len, named.values())) < 3 * LONGEST
    want = 0.3
    for _ in range(30):
        want = 3.5 * want * (1.0 - want)
    assert values_of(logistic, x=0.3)["x"] == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: {"x": 1.0 if x > 0 else 0.0}, r"branches on the value of \(x > 0.0\)"),
        (lambda x: {"x": math.sin(x)}, "use numpy's functions"),
        (lambda x: {"x": np.floor(x)}, "floor of 1 is no function of formulas"),
        (lambda x: x, "must return rates by state"),
    ],
)
def test_what_cannot_be_written_as_a_formula_is_refused(function, message):
    with pytest.raises(ValueError, match=f"^my.py:f: TypeError: .*{message}"):
        formulas_of(function, "my.py:f")


def given_by(tmp_path, code=CODE):
    file = tmp_path / "dynamics.py"
    file.write_text(code, encoding="utf-8")
    model = {k: v for k, v in described().items() if k != "rates"}
    return file, replace(STUDY, model={**model, "function": "dynamics.py:rates"}, folder=tmp_path)


def test_code_is_run_only_where_the_command_line_names_its_file(tmp_path):
    file, study = given_by(tmp_path, "raise SystemExit('was run')\n" + CODE)
    (problem,) = description_of(study).problems(study)
    assert problem.severity == "warning" and "--setup dynamics.py" in problem.message
    with pytest.raises(ValueError, match="is code, which is not run unless you say so"):
        setup_of(study)
    with pytest.raises(SystemExit, match="was run"):
        own_setup(file, study)


def test_a_function_is_the_system_of_its_formulas(tmp_path):
    file, study = given_by(tmp_path)
    made, written = own_setup(file, study), setup_of(STUDY)
    run, q = STUDY.runs[1], written.model.at_prior()
    torch.testing.assert_close(made.model.predict(run, q), written.model.predict(run, q))
    assert [e.name for e in made.effects] == [e.name for e in written.effects]
    assert made.study is not None and "function" not in made.study.model


def test_a_file_that_the_study_does_not_name_is_refused(tmp_path):
    file, study = given_by(tmp_path)
    with pytest.raises(ValueError, match=r"has no function setup\(study\), and the study"):
        own_setup(file, STUDY)
    other = replace(study, model={**study.model, "function": "dynamics.py:rate"})
    with pytest.raises(ValueError, match="has no function 'rate'"):
        own_setup(file, other)
    with pytest.raises(ValueError, match="give rates, or function"):
        description_of(replace(STUDY, model={**STUDY.model, "function": "dynamics.py:rates"}))
    assert with_function(study, lambda x, v: {"x": v, "v": -x}).model["rates"]["v"] == "(-x)"
