"""benchmarks/stokes_amplifier.py at tiny size."""

from __future__ import annotations

from benchmarks import stokes_amplifier


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
