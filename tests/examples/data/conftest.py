"""SharedStretch data of the data tests: the measured beam if it is there, a virtual one always."""

from pathlib import Path

import pytest

from diffsim.data import find_dataset
from examples.data.beam import BeamStudy, load_beam_study

VIRTUAL_BEAM = Path(__file__).parents[3] / "examples" / "demo" / "virtual_beam"


@pytest.fixture(scope="session")
def measured_beam() -> BeamStudy:
    folder = find_dataset("silicone_beam")
    if folder is None:
        pytest.skip("no measured data: set DIFFSIM_DATA to the folder that holds silicone_beam/")
    return load_beam_study(folder)


@pytest.fixture(scope="session")
def virtual_folder() -> Path:
    return VIRTUAL_BEAM


@pytest.fixture(scope="session")
def virtual_beam(virtual_folder: Path) -> BeamStudy:
    return load_beam_study(virtual_folder)
