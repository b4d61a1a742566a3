"""``diffsim diagnose next`` of a described system: its bank is made from the study's commands."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from diffsim import cli
from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.data import Command, load_study, save_study
from diffsim.diagnose.refit import wanted_columns
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem, save_extended
from diffsim.identify.law import Entry, Law, Variable
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import WhiteNoise
from tests.systems.toy_cart import cart_study, described


def report_of(study) -> dict:
    """A report that leaves two laws of friction open, by whatever names the library has."""
    known = [e.name for e in inputs_of(study, seed=0).setup.effects]
    dry, drag = (
        next(name for name in known if name.startswith(begin))
        for begin in (("dry_friction", "coulomb_friction"), ("square_drag", "quadratic_drag"))
    )
    table = [{"effect": dry}, {"effect": drag}]
    open_sets = {"verdict": "ambiguous", "named": [dry], "rivals": [[drag]]}
    return {**open_sets, "table": table, "hypotheses": [], "settings": {}}


def thinned(run):
    command = {"force": run.command["force"][::4]}
    return replace(run, time_s=run.time_s[::4], measured=run.measured[::4], command=command)


@pytest.fixture
def folder(tmp_path):
    """A cart with dry friction; start places differ from run to run, and are fitted."""
    start = {"x0": {"value": 0.0, "sd": 1e-3, "per": "run", "unit": "m"}}
    model = described(states={"x": "x0", "v": "0"})
    model["parameters"] = {**model["parameters"], **start}
    study = cart_study(force=lambda x, v: -0.6 * np.tanh(v / 1e-3), model=model)
    limits = Command("force", "N", lower=-20.0, upper=20.0, rate=400.0)
    study = replace(study, commands=(limits,), runs=tuple(map(thinned, study.runs)))
    save_study(study, tmp_path / "study")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.json").write_text(json.dumps(report_of(study)))
    return tmp_path


def test_runs_of_the_bank_have_parameters_of_their_own(folder):
    study = load_study(folder / "study")
    inputs = inputs_of(study, seed=0, with_bank=True)
    names = {p.name for p in inputs.setup.model.base}
    assert inputs.setup.bank and {f"x0@{run.name}" for run in inputs.setup.bank} <= names
    assert inputs.study.runs == study.runs  # what was recorded stays what it was
    assert not inputs_of(study, seed=0).setup.bank


def test_next_says_what_to_record_and_writes_it(folder, capsys):
    argv = ["diagnose", "next", str(folder / "study"), "--out", str(folder / "out"), "--csv"]
    assert cli.main([*argv, "--debug"]) == 0
    said = capsys.readouterr().out
    advice = json.loads((folder / "out" / "next.json").read_text())
    assert f"record {advice['best']}: it parts the nearest two by " in said
    gains = advice["chi2_gain"]
    assert len(gains) > 10 and gains[advice["best"]] == max(gains.values()) > 2.0 * min(
        gains.values()
    )
    lines = (folder / "out" / "next.csv").read_text().splitlines()
    assert lines[0] == "time_s,force (N)" and len(lines) > 50


DRAG = Entry("force", "cart", "N", 1.0)
SPEED = Variable("v", "v", "m/s")


def test_next_parts_two_forms_of_a_law_that_nobody_listed(folder):
    """They are causes of the saved model alone; the run where the cart is fastest tells them."""
    study = load_study(folder / "study")
    port = inputs_of(study, seed=0).setup.laws
    laws = [
        Law("law_square", DRAG, SPEED, "square", "size*u*abs(u)", 0.5, "N"),
        Law("law_cube", DRAG, SPEED, "power", "size*u**3", 0.5, "N"),
    ]
    made = port.setup_with([port.block(law) for law in laws])
    first = next(e for e in made.effects if e.name == "law_square")
    problem = Problem(made.model, study.fit_runs, WhiteNoise(study.channels), (first,))
    fit, _ = gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))
    out = folder / "out"
    save_extended(fit, out / "extended_model.yaml", study=study, verdict="described")
    report = {
        "verdict": "described",
        "named": ["law_square"],
        "rivals": [["law_cube"]],
        "table": [{"effect": law.name} for law in laws],
        "hypotheses": [],
        "settings": {},
    }
    (out / "report.json").write_text(json.dumps(report))
    argv = ["diagnose", "next", str(folder / "study"), "--out", str(out), "--debug"]
    assert cli.main(argv) == 0
    advice = json.loads((out / "next.json").read_text())
    assert advice["rivals"] == [["law_square"], ["law_cube"]]
    gains = sorted(advice["chi2_gain"].values())
    assert advice["chi2_gain"][advice["best"]] == gains[-1] > 10.0 * gains[0] > 0.0


def test_another_description_is_another_diagnosis(folder):
    study = load_study(folder / "study")
    moved = replace(study, model={**study.model, "time_step": 0.01})
    first, second = (inputs_of(s, seed=0).fingerprint["study"] for s in (study, moved))
    assert first != second


def test_no_run_is_advised_beyond_the_travel_of_a_channel(folder, capsys):
    argv = ["diagnose", "next", str(folder / "study"), "--out", str(folder / "out"), "--debug"]
    file, report = folder / "study" / "study.yaml", folder / "out" / "report.json"
    content = json.loads(report.read_text())
    cold = {"status": "not judged", "note": "a column of temperature", "words": "warm grease"}
    report.write_text(json.dumps({**content, "causes": [cold]}))
    given = yaml.safe_load(file.read_text())
    reach = max(np.abs(run.measured[:, 0]).max() for run in load_study(folder / "study").runs)
    advised = []
    for travel in (1.2 * float(reach), 1e-6):
        given["channels"][0] |= {"lower": -travel, "upper": f"{1000 * travel} mm"}
        file.write_text(yaml.safe_dump(given))
        if travel == 1e-6:
            with pytest.raises(ValueError, match="leave the travel"):
                cli.main(argv)
            continue
        assert cli.main(argv) == 0
        advised = json.loads((folder / "out" / "next.json").read_text())["chi2_gain"]
    said = capsys.readouterr().out
    assert "warm grease could not be judged: record a column of temperature" in said

    bank = inputs_of(load_study(folder / "study"), seed=0, with_bank=True).setup.bank
    assert 0 < len(advised) < len(bank)


def test_what_no_record_would_mend_is_not_asked_for():
    """It said: "record its derivative could not be confirmed"."""
    row = {"status": "not judged", "words": "lag", "probability": 0.2}
    rows = [row | {"note": "its derivative could not be confirmed"}]
    rows.append(row | {"note": "not judged: repeats differ more than the noise", "words": "play"})
    said = wanted_columns({"verdict": "named", "causes": rows})
    assert said == [
        "lag could not be judged: its derivative could not be confirmed",
        "play could not be judged: repeats differ more than the noise",
    ]
