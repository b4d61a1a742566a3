"""``diffsim diagnose extend`` with further recordings: sizes mean what they meant at the fit."""

import numpy as np
import yaml

from diffsim.cli import main
from diffsim.core.files import to_plain
from diffsim.data import load_study
from diffsim.systems import setup_of

STUDY = """
name: thrust
channels: [{name: thrust_N, unit: N, sd: 0.02}]
commands: [{name: speed, unit: rad/s}]
runs:
RUNS
model:
  system: bench
  parameters: {c: {value: 1e-5, percent: 30}}
  define: {thrust: c*speed**2}
  readings: {thrust_N: thrust}
  laws: [{name: thrust, of: speed, unit: N}]
"""
EXPONENT, USUAL = 0.1, 500.0


def record(path, most):
    """A sweep of a law that grows by 0.1 faster than the square of the speed."""
    speed = np.linspace(0.1, 1.0, 40) * most
    thrust = 1e-5 * speed**2 * (speed / USUAL) ** EXPONENT
    rows = zip(np.arange(40.0), speed, thrust, strict=True)
    path.write_text("time_s,speed,thrust_N\n" + "".join(f"{t},{s},{y}\n" for t, s, y in rows))


def test_sizes_keep_their_meaning_when_faster_runs_are_added(tmp_path, capsys):
    for name, most in (("slow", 800.0), ("again", 700.0), ("fast", 2400.0)):
        record(tmp_path / f"{name}.csv", most)
    runs = ["  - {name: slow, file: slow.csv}", "  - {name: again, file: again.csv}"]
    file = tmp_path / "study.yaml"
    file.write_text(STUDY.replace("RUNS", "\n".join(runs)))
    model = setup_of(load_study(tmp_path)).model
    saved = {
        "model": model.name,
        "parameters": {"c": {"value": 1e-5, "sd": 1e-7, "unit": "-"}},
        "effects": {"exponent_of_thrust": {"value": EXPONENT, "sd": 0.01, "unit": "-"}},
        "frame": to_plain(dict(model.frame)),
    }
    (tmp_path / "first.yaml").write_text(yaml.safe_dump(saved))
    extend = ["diagnose", "extend", str(tmp_path), "--model", str(tmp_path / "first.yaml")]
    assert main([*extend, "--out", str(tmp_path / "few")]) == 0
    file.write_text(STUDY.replace("RUNS", "\n".join([*runs, "  - {name: fast, file: fast.csv}"])))
    assert main([*extend, "--out", str(tmp_path / "all")]) == 0
    few, more = (
        yaml.safe_load((tmp_path / name / "extended_model.yaml").read_text())
        for name in ("few", "all")
    )
    assert more["frame"] == few["frame"] == saved["frame"]
    # c is the coefficient at the usual speed of the first runs, not at that of all
    ratio = more["parameters"]["c"]["value"] / few["parameters"]["c"]["value"]
    np.testing.assert_allclose(ratio, 1.0, rtol=5e-3)
