"""Scaled readings in the unit of the recordings."""

import numpy as np
import pytest

from diffsim.data.shown import shown, shown_change
from diffsim.data.study import Channel
from diffsim.data.study_file import load_study

YAML = """
name: bench
model: {{system: bench, numbers: {{a: {{value: 1}}}}, readings: {{load: a*x}}}}
channels: [{{name: load, formula: asinh(0.01/200*F)/0.01, unit: "-", sd: 1{more}}}]
commands: [{{name: x, unit: "-"}}]
runs: [{{file: a.csv}}]
"""
SCALED = Channel(
    "load", "-", "force", 1.0, "kN", shown_formula="0.2/0.01*sinh(0.01*load)"
)  # asinh(0.01/200 F)/0.01 of a force F [N]


def test_scaled_readings_are_shown_in_the_unit_of_the_recordings():
    forces = np.array([0.0, 150.0, 2.0e4, -3.0e5, np.nan])
    scaled = np.arcsinh(0.01 / 200.0 * forces) / 0.01
    np.testing.assert_allclose(shown(SCALED, scaled), 1e-3 * forces, rtol=1e-12)


def test_one_noise_sd_is_the_floor_at_rest_and_a_share_of_large_readings():
    forces = np.array([0.0, 1.0e7])
    scaled = np.arcsinh(0.01 / 200.0 * forces) / 0.01
    noise = shown_change(SCALED, scaled, np.ones(2))
    np.testing.assert_allclose(noise, 1e-3 * np.array([200.0, 0.01 * 1e7]), rtol=0.01)


def test_units_alone_are_a_factor():
    channel = Channel("tip_m", "m", "position", 1e-3, "mm")
    assert shown_change(channel, np.array([5.0]), np.array([2e-3])) == 2.0
    assert shown(channel, np.array([5e-3])) == 5.0


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (", shown_formula: load", "needs shown_unit"),
        (", shown_formula: 2*F, shown_unit: N", "'F' is not known here"),
    ],
)
def test_a_formula_that_cannot_be_shown_is_refused(tmp_path, more, said):
    (tmp_path / "a.csv").write_text("time_s,x,F\n" + "".join(f"{t},1,2\n" for t in range(12)))
    (tmp_path / "study.yaml").write_text(YAML.format(more=more))
    with pytest.raises(ValueError, match=said):
        load_study(tmp_path / "study.yaml")
