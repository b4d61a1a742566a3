"""benchmarks/stokes_sampling.py and stokes_amplifier.py at tiny size: starts, tables."""

import json

import pytest

from benchmarks import stokes_amplifier, stokes_sampling
from diffsim.stokes import devices


def test_writes_table_and_figure(tmp_path):
    arguments = ["amplifier", "--resolution", "0.25", "--samples", "3", "--evaluations", "4"]
    (result,) = stokes_sampling.main([*arguments, "--out", str(tmp_path)])
    whole = devices.optimize(devices.make("amplifier", 0.25), 3, max_evaluations=4, progress=False)
    assert result["histories"][0] == pytest.approx(whole.evaluation_losses.tolist(), rel=1e-12)
    # every history begins with a random design; their mean is 1
    assert sum(h[0] for h in result["histories"]) / 3 == pytest.approx(1.0)
    assert all(f == min(h) for f, h in zip(result["finals"], result["histories"], strict=True))
    kept = json.loads((tmp_path / "results.json").read_text())["devices"][0]
    assert kept["finals"] == result["finals"]
    assert "| amplifier | 3 |" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "sampling.png").stat().st_size > 10_000


def test_summary_counts_starts_that_end_better_and_those_that_are_stuck():
    result = {
        "device": "made up",
        "finals": [0.2, 0.1, 0.15, 0.9],
        "histories": [[0.5, 0.2], [1.5, 0.1], [1.0, 0.15], [1.0, 0.9]],
    }
    row = stokes_sampling.summary(result)
    assert (row["first"], row["sampled"]) == (0.5, 0.2)
    assert (row["best"], row["median"], row["worst"]) == (0.1, 0.15, 0.9)
    assert (row["better"], row["stuck"], row["count"]) == (2, 1, 3)
    assert row["evaluations"] == 8


def test_starts_are_the_best_sample_and_others(tmp_path, capsys):
    arguments = ["amplifier", "--resolution", "0.25", "--samples", "3", "--evaluations", "2"]
    (result,) = stokes_sampling.main([*arguments, "--starts", "2", "--out", str(tmp_path)])
    assert len(result["histories"]) == 2
    assert result["histories"][0][0] < 1.0  # the best of three, in units of their mean
    with pytest.raises(SystemExit):
        stokes_sampling.main([*arguments, "--starts", "4", "--out", str(tmp_path)])
    assert "--starts must lie between 2" in capsys.readouterr().err


def test_larger_ratios_and_finer_grids_come_closer(tmp_path):
    results = stokes_amplifier.main(
        ["--scales", "1", "2", "--ratios", "0.45", "0.49", "0.499", "--out", str(tmp_path)]
    )
    to_stiffest = [row["to_stiffest"] for row in results["stiffening"]]
    assert to_stiffest[0] > to_stiffest[1] > to_stiffest[2] == 0.0
    # The thesis's measure goes to zero; the distance to the incompressible flow does not.
    assert results["stiffening"][-1]["to_incompressible"] > 0.02
    refinement = [r for r in results["refinement"] if r["poissons_ratio"] == 0.45]
    assert 0.0 < refinement[0]["to_finest"] < 0.05 < refinement[-1]["to_incompressible"]
    text = (tmp_path / "report.md").read_text()
    assert text.count("| default |") == 2
