"""The virtual laboratory against closed forms, and that its effects are in its recordings."""

from pathlib import Path

import numpy as np
import pytest

from examples.data.beam import load_beam_study
from examples.data.beam_motion import describe, moving_tip_mass
from labs.virtual.clamped_beam import VirtualBeam, _Plane, bending_modes, write_beam_study

VIRTUAL_BEAM = Path(__file__).parents[3] / "examples" / "demo" / "virtual_beam"


@pytest.mark.reference
def test_slender_beam_has_the_textbook_frequencies():
    beam = VirtualBeam(length=1.0, num_modes=4, num_elements=40)
    ei = beam.youngs_modulus * beam.width * beam.height**3 / 12
    unit = np.sqrt(ei / (beam.density * beam.width * beam.height)) / beam.length**2
    roots = np.array([1.875104, 4.694091, 7.854757, 10.995541])
    # L/h = 33: shear and rotary inertia lower the fourth by some per cent, the first by 0.3 %
    error = bending_modes(beam).omega / (roots**2 * unit) - 1
    assert abs(error[0]) < 4e-3
    assert np.all(error < 0) and np.all(np.diff(error) < 0)


@pytest.mark.reference
def test_sag_has_bending_and_shear():
    beam = VirtualBeam(num_modes=24)
    e, nu, length = beam.youngs_modulus, beam.poissons_ratio, beam.length
    area, inertia = beam.width * beam.height, beam.width * beam.height**3 / 12
    shear = 10 * (1 + nu) / (12 + 11 * nu) * e / (2 * (1 + nu)) * area
    tip = 0.51 * (length**3 / (3 * e * inertia) + length / shear)
    own = beam.density * area * beam.gravity
    field = own * (length**4 / (8 * e * inertia) + length**2 / (2 * shear))
    modes = bending_modes(beam)
    # 24 of 48 modes: the rest carries less than 0.2 % of a tip load's deflection
    assert modes.sag(0.51, 0.0) == pytest.approx(tip, rel=2e-3)
    assert modes.sag(0.0, beam.gravity) == pytest.approx(field, rel=2e-3)


@pytest.mark.property
def test_held_state_stays_until_it_is_let_go():
    beam = VirtualBeam()
    plane = _Plane(bending_modes(beam), beam, weight=beam.load_mass)
    x, force = plane.held(0.0)
    states = plane.run(x, np.full(4000, force), 40)
    np.testing.assert_allclose(states, np.broadcast_to(x, states.shape), atol=1e-9)
    assert plane.tip(x)[0] == pytest.approx(0.0, abs=1e-12)
    assert plane.tip(x)[1] > 0  # a propped tip points up
    assert force > beam.load_mass * beam.gravity


@pytest.mark.property
def test_energy_never_grows_and_the_beam_ends_at_its_sag():
    beam = VirtualBeam()
    modes = bending_modes(beam)
    plane = _Plane(modes, beam)
    x, _ = plane.held(0.0)
    states = plane.run(x, np.zeros(120_000), 40)
    height = plane.tip(states)[0]
    # 30 s are ten times the slowest relaxation
    assert height[-1] == pytest.approx(-modes.sag(0.0, beam.gravity), rel=1e-3)
    swing = np.abs(height - height[-1])
    assert swing[2000:].max() < 0.01 * swing[:100].max()


def test_the_kept_recordings_are_what_the_laboratory_makes(tmp_path):
    """The demo reads them; the last digit of a matrix exponential differs between processors."""
    made = write_beam_study(tmp_path)
    assert {file.name for file in made.iterdir()} == {file.name for file in VIRTUAL_BEAM.iterdir()}
    kept, anew = load_beam_study(VIRTUAL_BEAM), load_beam_study(made)
    assert kept.metadata["truth"] == anew.metadata["truth"]
    for one, other in zip(kept.trials, anew.trials, strict=True):
        np.testing.assert_allclose(
            one.recording.position_m, other.recording.position_m, rtol=0.0, atol=1.01e-6
        )
        assert one.release_frame == other.release_frame


def test_recordings_differ_by_seed_and_repeat(tmp_path):
    other = load_beam_study(write_beam_study(tmp_path, seed=3))
    kept = load_beam_study(VIRTUAL_BEAM)
    a, b, c = (s.trials[k].recording.position_m for s, k in ((kept, 0), (kept, 1), (other, 0)))
    assert np.abs(a - b).max() > 1e-4 and np.abs(a - c).max() > 1e-4


def test_effects_of_the_measured_beam_are_there():
    virtual_beam = load_beam_study(VIRTUAL_BEAM)
    numbers = describe(virtual_beam)
    f = {name: n["frequency_Hz"] for name, n in numbers["trials"].items()}
    mass = moving_tip_mass(f["gravity_a"], f["load52_a"], 0.05202)
    assert mass == pytest.approx(virtual_beam.geometry.mass_kg / 4, rel=0.08)
    for n in numbers["trials"].values():
        assert 0.03 < n["damping_ratio"] < 0.08
        assert 0.01 < n["creep_share_per_decade"] < 0.08
    floor = numbers["repeats"]["gravity"]
    assert 10e-6 < floor["vertical_rms_m"] < 0.5e-3


def test_report_of_virtual_data_can_tell():
    study = load_beam_study(VIRTUAL_BEAM)
    assert study.is_virtual
    assert "VIRTUAL" in study.metadata["title"]
    assert study.metadata["truth"]["youngs_modulus"] > 0


def test_refuses_impossible_beams():
    with pytest.raises(ValueError, match=r"poissons_ratio must lie in \(-1, 0.5\), got 0.5"):
        VirtualBeam(poissons_ratio=0.5)
    with pytest.raises(ValueError, match=r"num_modes must lie in \[1, num_elements = 24\]"):
        VirtualBeam(num_modes=25)
