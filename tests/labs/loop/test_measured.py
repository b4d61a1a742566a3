"""Are windows of the real recordings what the model expects?"""

import numpy as np
import pytest

from diffsim.core.paths import data_folder
from labs.loop import FitSettings, Starfish, on_real_recording
from labs.loop.measured import SPACING_M, window
from labs.loop.recordings import COMMAND, import_starfish

FOLDER = data_folder()
pytestmark = pytest.mark.skipif(
    FOLDER is None or not (FOLDER / "starfish").is_dir(),
    reason="the starfish recordings are not there; set DIFFSIM_DATA",
)


def test_windows_are_at_60_hz_and_to_scale():
    for run in import_starfish().runs:
        cut = window(run, 2.0)
        assert np.ptp(np.diff(cut.time_s)) < 1e-12
        assert len(cut.time_s) == 120
        assert np.isfinite(cut.measured).all() and np.isfinite(cut.command[COMMAND]).all()
        between = np.hypot(*(cut.measured[0, 4:6] - cut.measured[0, 2:4]))
        assert between == pytest.approx(SPACING_M, rel=0.01)  # m2 to m3
        # the command begins within the window, not before
        assert np.abs(np.diff(cut.command[COMMAND][:8])).max() < 2e-4


@pytest.mark.slow
def test_identification_explains_more_than_the_first_guesses():
    settings = FitSettings(duration_s=1.5, max_evaluations=8)
    found = on_real_recording(import_starfish(), Starfish(), settings)
    fitted = found["runs"][0]
    assert fitted["use"] == "fit"
    assert fitted["rms_after_m"] < fitted["rms_before_m"]
