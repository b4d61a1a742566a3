"""Recordings of hidden laws: what a study shows, what stays sealed, and how fine steps are."""

import subprocess
import sys

import numpy as np
import pytest
import yaml

from diffsim.cli import main as diffsim_command
from labs.unlisted.catalog import KINDS, UNLISTED
from labs.unlisted.draw import COARSE, drawn, sized
from labs.unlisted.machine import Courses, simulate
from labs.unlisted.record import recorded, write

GENERATORS = ("machine", "courses", "rigs", "laws_of_turning", "laws_of_moving",
              "laws_of_flow_and_sensors", "listed", "catalog", "draw", "record")  # fmt: skip

SHORT = 100  # samples


def test_generators_share_no_code_with_the_package():
    lines = [f"import labs.unlisted.{name}" for name in GENERATORS]
    lines.append("import sys; assert not [m for m in sys.modules if m.startswith('diffsim')]")
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True)


def test_a_study_passes_its_check_and_does_not_tell_the_truth(tmp_path, capsys):
    case = drawn(3, "warm_damping", 0)
    write(recorded(case, 2e-3), tmp_path)
    said = (tmp_path / "study" / "study.yaml").read_text()
    # the recorder wrote the temperature, the description does not use it
    assert "temp" not in said and "warm" not in said
    assert "temp" in (tmp_path / "study" / "run_1.csv").read_text().splitlines()[0].split(",")
    assert diffsim_command(["diagnose", "check", str(tmp_path / "study")]) == 0
    assert "ready for a diagnosis" in capsys.readouterr().out
    truth = yaml.safe_load((tmp_path / "truth.yaml").read_text())
    assert {"kind": "number", "target": "damping"} in truth["entry"]
    assert ["temp"] in truth["variables"] and truth["numbers"]["rate"] == -2e-3
    noisy, clean = (np.loadtxt(tmp_path / part / "run_8.csv", delimiter=",", skiprows=1)
                    for part in ("study", "without_noise"))  # fmt: skip
    shown = 1 + np.arange(len(case.machine.dials))
    assert np.array_equal(np.delete(noisy, shown, 1), np.delete(clean, shown, 1))
    assert np.all((noisy - clean)[:, shown].std(axis=0) > 0.0)
    uses = [run["use"] for run in yaml.safe_load(said)["runs"]]
    assert uses.count("fit") == 5 and uses.count("select") == 2 and "test" in uses


@pytest.mark.parametrize("kind", ["cogging", "warm_winding", "creeping_cell"])
def test_a_law_is_as_visible_as_wanted(kind):
    case = drawn(3, kind, 0)
    size, misfit = sized(case)
    assert 0.9 < misfit.strength / case.wanted < 1.11
    assert 0.0 < size <= case.law.most
    assert max(rms / case.machine.dials[n].sd for n, rms in misfit.rms.items()) > 0.1


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_machine_moves_and_halved_steps_change_nothing(kind):
    """Every machine with its law at a usual size; the error of a step is far below the noise."""
    case = drawn(3, kind, 0)
    law, machine = case.law, case.machine
    size = min(law.typical, law.most) if law else 0.0
    begun = Courses(
        {name: course[:, :SHORT] for name, course in case.courses.commands.items()},
        {name: course[:, :SHORT] for name, course in case.courses.columns.items()},
    )
    seen = simulate(machine, case.numbers, begun, law, size, COARSE)
    finer = simulate(machine, case.numbers, begun, law, size, 2 * COARSE)
    sd = np.array([dial.sd for dial in machine.dials.values()])[:, None, None]
    assert np.sqrt(np.mean(((seen - finer) / sd) ** 2)) < 0.02
    assert np.all(seen.std(axis=(1, 2)) > 3.0 * sd[:, 0, 0])
    if law:
        plain = simulate(machine, case.numbers, begun, substeps=COARSE)
        assert np.abs(seen - plain).max() > 0.0


def test_every_law_says_where_it_enters_among_what_its_study_has():
    for name, kind in KINDS.items():
        if kind.group != UNLISTED:
            continue
        for turn in range(len(kind.machines)):
            case = drawn(3, name, turn)
            machine = case.machine
            known = {
                "force": {place["name"] for place in machine.places},
                "rate": set(machine.states),
                "number": set(machine.numbers),
                "input": set(machine.drives),
                "reading": set(machine.dials),
            }
            for store in machine.more.get("stores", ()):
                known["force"].add(store["name"])
            if not machine.places:
                known["force"].add("plate")
            assert all(target in known[entry] for entry, target in case.law.entry), name
            shown = {*machine.states, *machine.drives, *machine.dials, *case.courses.columns}
            assert any(set(own) <= shown for own in case.law.variables), name
            assert case.law.forms and case.law.columns == tuple(
                c for c in case.law.columns if c in case.courses.columns
            )


def test_rows_get_lost_and_noise_is_colored_where_that_is_the_dirt():
    lost = recorded(drawn(3, "sound_lost_rows", 0))
    counts = [len(table["time"]) for table in lost.tables.values()]
    full = drawn(3, "sound_lost_rows", 0).machine.count
    assert all(0.93 * full < count < full for count in counts)
    case = drawn(3, "sound_colored", 0)
    clean = simulate(case.machine, case.numbers, case.courses)
    (name, dial), *_ = case.machine.dials.items()
    noise = recorded(case).tables["run_1.csv"][name] / dial.per_si - clean[0, 0]
    assert noise.std() == pytest.approx(dial.sd, rel=0.15)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(0.6, abs=0.1)
