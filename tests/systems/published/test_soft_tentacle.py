"""The soft tentacle: what elements cost, what sessions changed, and poses that no fit has seen."""

from pathlib import Path

import numpy as np
import pytest
import torch

from diffsim.data import load_study
from diffsim.data.study_check import check_study
from diffsim.identify import Numerics
from diffsim.systems import published
from diffsim.systems.registry import setup_of
from tests.diagnose.discover.answers import answer
from tests.measured import data_folder
from tests.systems.published.fits import fitted

pytestmark = pytest.mark.reference
FILE = Path(published.__file__).parent / "soft_tentacle.yaml"
PUBLISHED = {"youngs_modulus": 315093.77, "density": 1317.66}  # identified by the authors
PUBLISHED_MM = 15.63  # of their rod, whose bending is linear along it, on these 14 poses
GOAL_MM = 9.0


@pytest.fixture(scope="module")
def study():
    data_folder("soft_tentacle")
    return load_study(FILE)


def distance_mm(shown, run):
    """Mean distance of the four markers [mm]."""
    apart = (np.asarray(shown) - run.measured).reshape(4, 3)
    return 1e3 * float(np.linalg.norm(apart, axis=1).mean())


def test_the_file_is_short_and_holds_four_poses_back(study):
    assert len(FILE.read_text().splitlines()) <= 60
    assert (len(study.fit_runs), len(study.test_runs)) == (10, 4)
    assert not [p for p in check_study(study) if p.severity == "error"]


@pytest.mark.parametrize(
    "meshes",
    [
        pytest.param(
            (1.0,),
            marks=pytest.mark.short_of(
                "test_a_finer_rod_alone_takes_three_of_sixteen_millimeters[finer]"
            ),
        ),
        pytest.param((1.0, 0.5), marks=pytest.mark.story),
    ],
    ids=["one", "finer"],
)
def test_a_finer_rod_alone_takes_three_of_sixteen_millimeters(study, meshes):
    model = setup_of(study).model
    q = model.at_prior()
    for i, parameter in enumerate(model.base):
        if parameter.name in PUBLISHED:
            q[i] = parameter.coordinate_of(PUBLISHED[parameter.name])
    errors = []
    for mesh in meshes:
        with torch.no_grad():
            shown = [model.predict(run, q, None, Numerics(mesh=mesh)) for run in study.runs]
        errors.append(np.mean([distance_mm(s, r) for s, r in zip(shown, study.runs, strict=True)]))
    assert errors[-1] == pytest.approx(12.4, abs=0.1)
    assert errors[0] == pytest.approx(errors[-1], abs=0.1)  # twelve elements are enough
    assert errors[-1] < PUBLISHED_MM - 3.0


def left_out(found, study):
    """Mean distance on the poses that were held back [mm]."""
    errors = []
    for run in study.test_runs:
        with torch.no_grad():
            shown = found.problem.predict(run, torch.from_numpy(found.x)).numpy()
        errors.append(distance_mm(shown, run))
    return np.mean(errors)


@pytest.mark.story
def test_poses_left_out_are_within_the_goal_and_causes_bring_them_nearer(study):
    plain = fitted(study)  # stiffness, density and places of markers
    found = fitted(study, "drive_loss", "tendon_distance", "tendon_turn", "clamp_tilt", "moved_m4")
    assert found.chi2 < 0.4 * plain.chi2
    assert found.values["drive_loss"] == pytest.approx(0.42, abs=0.15)  # N
    assert found.values["tendon_distance"] == pytest.approx(3.7e-3, abs=1.5e-3)  # to the surface
    assert found.values["youngs_modulus"] > 1.5 * PUBLISHED["youngs_modulus"]
    assert left_out(plain, study) < GOAL_MM
    assert left_out(found, study) < left_out(plain, study) - 1.0


@pytest.mark.slow
def test_the_loss_of_the_drives_is_named(study):
    report = answer(study)
    status = {c.name: c.status for c in report.causes}
    assert report.verdict == "named"
    # likely only: ten poses, and none that is left out confirms the gain by one cause alone
    # a marker that moved was, before sets with stiffening in compression were tried
    for name in ("drive_loss", "tendon_distance"):
        assert status[name] in ("certain", "likely"), name
    assert {status[n] for n in ("tendon_friction", "pretension", "tendon_end")} == {"refuted"}
    assert not any("derivative could not be confirmed" in said for said in report.sentences)
    after = np.array([e.after for e in report.errors if e.use == "test"])
    assert after.mean() < 5.0  # mm a coordinate
