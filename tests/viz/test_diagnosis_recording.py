"""Names of runs in recordings for rerun."""

from types import SimpleNamespace

import numpy as np

from diffsim.data.study import Channel, Run
from diffsim.viz import diagnosis_recording
from tests.optional import needs

needs("rerun", reason="recordings need pip install -e '.[viz]'")


def test_names_with_spaces_and_slashes_are_one_part_of_a_path(tmp_path, monkeypatch, capfd):
    time_s = np.linspace(0.0, 1.0, 5)
    measured = np.sin(time_s)[:, None]
    run = Run("seq B/2", time_s, measured, {"pull": time_s}, "a")
    study = SimpleNamespace(
        name="rig",
        channels=(Channel("tip x", "m", "position", 1.0),),
        fit_runs=(run,),
        test_runs=(),
    )
    report = SimpleNamespace(
        study=study, verdict="none", sentences=("Noise.",), named=(), null=None, best=None
    )
    monkeypatch.setattr(diagnosis_recording, "predicted", lambda fit, run: measured)
    path = diagnosis_recording.write_recording_of(report, tmp_path / "runs.rrd")
    said = capfd.readouterr()
    assert b"/seq\\ B\\/2/tip\\ x/measured" in path.read_bytes()
    assert "Unescaped" not in said.err + said.out
