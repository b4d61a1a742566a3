"""The demo ends with a page and numbers, with measured data or without."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffsim import cli
from diffsim.data import find_dataset
from examples import demo
from examples.demo.numerics import euler_damping_ratio
from tests.optional import needs

needs("matplotlib", reason="the demo's page needs the extra viz")
needs("jinja2", reason="the demo's page needs the extra viz")


pytestmark = pytest.mark.example


@pytest.mark.cpu(12)  # the whole demo, two fits and 24 pictures (each for a phone, too: 6 s)
def test_virtual_data_are_announced_on_the_page_and_in_the_picture(short_run):
    out, results = short_run
    assert results["is_virtual"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("VIRTUAL DATA") == 2
    assert "simulated against virtual" in page
    drawn = page.count("<source media=")  # letters of 3 px on a phone without
    assert drawn == page.count("<picture>") > 10
    assert (out / "figures" / "beam.png").read_bytes()[:4] == b"\x89PNG"


def test_page_and_json_hold_the_numbers(short_run):
    out, results = short_run
    kept = json.loads((out / "results.json").read_text())
    assert kept["verdict"] == results["verdict"] and len(kept["verdict"]) == 5
    assert kept["stored"] == kept["compared"] == []  # no answers come with these sizes
    trials = {"gravity_a", "gravity_b", "load52_a", "load52_b"}
    models = {"published_number", "published", "undamped", "identified", "mass", "joint"}
    assert set(kept["remaining"]) == set(kept["models"]) == models
    for by_trial in kept["remaining"].values():
        assert set(by_trial) == trials
        for left in by_trial.values():
            assert 0 < left["vertical_rms_best_shift_m"] <= left["vertical_rms_m"] * (1 + 1e-9)
            assert left["vertical_rms_m"] <= left["rms_m"]
    page = (out / "report.html").read_text(encoding="utf-8")
    for model in ("published", "identified", "joint"):
        assert f"{1e3 * kept['remaining'][model]['gravity_b']['vertical_rms_m']:.3f}" in page
    for sentence in kept["verdict"]:
        assert sentence.split("'")[0] in page  # an apostrophe is escaped
    assert page.count("<img") >= 12
    # three sentences for anybody, then the picture, then numbers
    three = page.index('<div class="verdict">'), page.index("<figure>"), page.index('class="number')
    assert len(results["opening"]) == 3 and three == tuple(sorted(three))
    # no cause is named in data that a laboratory computed
    assert "skipped" in kept["diagnosis"] and "virtual laboratory" in page


@pytest.mark.story
def test_recovers_the_truth_of_the_virtual_laboratory(virtual_run):
    """The laboratory is a Timoshenko beam, so its modulus is compared through beam theory.

    3 %: two thirds is the release, unknown to a camera frame, in a window of 0.6 s; the rest is
    creep, which the simulation lacks.
    """
    _, results = virtual_run
    truth = results["virtual_truth"]
    omega_tau = 2 * np.pi * 7.8 * np.array(truth["relaxation_times"])
    stiffer = np.mean(omega_tau**2 / (1 + omega_tau**2)) * truth["relaxing_share"]
    dynamic = truth["youngs_modulus"] * (1 + stiffer)
    assert results["youngs_modulus"]["motion_by_beam_theory_Pa"] == pytest.approx(dynamic, rel=0.03)
    run = results["simulated"]["identified"]["gravity"]
    measured = results["measured"]["trials"]["gravity_b"]
    assert run["frequency_Hz"] == pytest.approx(measured["frequency_Hz"], rel=0.02)
    # a trajectory fit lets damping pay for a straight start and for creep, too
    assert run["damping_ratio"] == pytest.approx(measured["damping_ratio"], rel=0.4)


@pytest.mark.story
def test_the_argument_of_the_page_holds(virtual_run):
    _, results = virtual_run
    runs, left = results["simulated"], results["remaining"]
    # implicit Euler's damping, as its step's complex multiplier says
    omega = 2 * np.pi * runs["undamped"]["gravity"]["frequency_Hz"]
    assert runs["published"]["gravity"]["damping_ratio"] == pytest.approx(
        euler_damping_ratio(omega, 1e-2), rel=0.03
    )
    assert abs(runs["undamped"]["gravity"]["damping_ratio"]) < 1e-3
    # a force leaves the frequency, a mass does not; the laboratory's weight is a mass
    light, loaded = (runs["identified"][case]["frequency_Hz"] for case in ("gravity", "load52"))
    assert loaded == pytest.approx(light, rel=0.01)
    assert runs["mass"]["load52"]["frequency_Hz"] < 0.65 * light
    for trial in ("load52_a", "load52_b"):
        assert left["mass"][trial]["vertical_rms_m"] < left["identified"][trial]["vertical_rms_m"]
    for trial in ("gravity_a", "gravity_b"):
        assert (
            left["identified"][trial]["vertical_rms_m"]
            < 0.6 * left["published"][trial]["vertical_rms_m"]
        )
    # published E and nu lock on any mesh this coarse
    sags = {(r["poissons_ratio"], tuple(r["cells"])): r["sag_m"] for r in results["mesh"]["rows"]}
    assert sags[0.499, (6, 2, 2)] < 0.5 * sags[0.45, (10, 4, 4)]
    assert results["sag_fit"]["history"][-1]["sag_m"] == pytest.approx(
        results["sag_fit"]["target_m"], rel=1e-6
    )


def test_recording_for_rerun(short_run):
    pytest.importorskip("rerun", reason="the .rrd recording needs rerun-sdk")
    out, results = short_run
    assert results["files"]["rerun"] == str(out / "beam.rrd")
    assert (out / "beam.rrd").read_bytes()[:4] == b"RRF2"
    rerun = Path(sys.executable).with_name("rerun")
    if rerun.exists():
        told = subprocess.run(
            [rerun, "rrd", "verify", out / "beam.rrd"], capture_output=True, text=True, timeout=60
        )
        assert told.returncode == 0, told.stderr


def test_resume_reuses_every_stage_and_gives_the_same_numbers(short_run, plan, monkeypatch):
    out, first = short_run
    monkeypatch.setattr("examples.demo.story.find_dataset", lambda *_: None)

    def forbidden(*_, **__):
        raise AssertionError("a finished stage was computed again")

    monkeypatch.setattr("examples.demo.story._write_page", lambda *_: None)  # seconds of pictures
    monkeypatch.setattr("examples.demo.ladder.simulate", forbidden)
    monkeypatch.setattr("examples.demo.fitting.fit_motion", forbidden)
    again = demo.run(out=out, plan=plan, resume=True, threads=1)
    assert again["verdict"] == first["verdict"]
    with pytest.raises(AssertionError, match="computed again"):  # another plan is another key
        demo.run(out=out, plan=replace(plan, dt_s=4e-3), resume=True, threads=1)


def test_ctrl_c_keeps_finished_stages(short_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("examples.demo.story.find_dataset", lambda *_: None)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("examples.demo.numerics.describe", interrupted)
    command = ["demo", "--quick", "--out", str(tmp_path / "run"), "--threads", "1"]
    assert cli.main(command) == 130
    stages = {path.stem for path in (tmp_path / "run" / "stages").glob("*.json")}
    assert stages == {"measured", "mesh", "sag_fit"}
    said = capsys.readouterr()
    assert "--resume" in said.err
    first = [line.split()[0] for line in said.out.splitlines() if line.strip()]
    # what was known before the long part
    assert first == ["VIRTUAL", "measured", "stiffness"]
    assert not (tmp_path / "run" / "report.html").exists()


def test_command_prints_the_verdict(short_run, monkeypatch, capsys):
    out, results = short_run
    monkeypatch.setattr("examples.demo.story.run", lambda **_: results)
    demo.main(quick=True)
    told = capsys.readouterr().out
    assert str(out / "report.html") in told
    assert "Hidden in the laboratory: E = 290 kPa at rest, 32" in told
    assert all(sentence in told for sentence in results["opening"])


def test_wrong_data_folder_does_not_fall_back_to_virtual(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"data=.*must be the folder that holds"):
        demo.run(data=tmp_path / "nowhere", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_measured_beam(tmp_path):
    folder = find_dataset("silicone_beam")
    if folder is None:
        pytest.skip("no measured data: set DIFFSIM_DATA to the folder that holds silicone_beam/")
    results = demo.run(out=tmp_path / "run", quick=True, threads=os.cpu_count())
    assert not results["is_virtual"]
    assert results["simulated"]["identified"]["gravity"]["frequency_Hz"] == pytest.approx(
        7.73, abs=0.08
    )
    assert results["simulated"]["mass"]["load52"]["frequency_Hz"] == pytest.approx(4.33, abs=0.15)
    floor = results["measured"]["repeats"]["gravity"]["vertical_rms_m"]
    left = {m: r["gravity_b"]["vertical_rms_m"] for m, r in results["remaining"].items()}
    assert left["identified"] < 2.0 * floor < 3.0 * floor < left["published"]
    diagnosis = results["diagnosis"]
    assert diagnosis["sentences"] and len(diagnosis["charts"]) == 3
    assert {row[0] for row in diagnosis["table"]} >= {"loss_factor", "creep", "support_motion"}
    # the mesh must not be what is diagnosed
    assert all(g["passed"] for g in diagnosis["gates"] if g["name"] in ("mesh", "time_step"))
