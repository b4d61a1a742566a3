"""A bar that swings freely: against beam theory, and alike on every mesh."""

import numpy as np
import pytest
import torch

from diffsim.data.beam import BeamGeometry
from diffsim.data.study import Channel, Run
from diffsim.systems.soft_body.released import BeamTip
from diffsim.systems.soft_body.swinging import bending_softness, swinging_beam

NU, LOAD_KG, SWING_M = 0.45, 0.05, 3e-3
BAR = BeamGeometry(
    length_m=0.1,
    width_m=0.03,
    height_m=0.03,
    density_kg_m3=1070.0,
    poissons_ratio=0.499,
    youngs_modulus_published_Pa=2.6e5,
    gravity_m_s2=9.81,
    marker_place_m={
        "tip1": (0.0, 0.015, 0.036),
        "tip2": (0.0, -0.006, 0.024),
        "tip3": (0.0, 0.036, 0.006),
    },
)
HEIGHT = (Channel("tip_z_m", "m", "position"),)


def swing(cells, load_kg=LOAD_KG):
    """Heights (num_samples,) every 10 ms and the model's Young's modulus."""
    time = np.arange(0.0, 0.8, 0.01)
    run = Run("a", time, np.zeros((len(time), 1)), {}, "g", setup={"tip_load_mass_kg": load_kg})
    model = swinging_beam(BAR, HEIGHT, {"a": SWING_M}, cells=cells, dt_s=2.5e-3)
    with torch.no_grad():
        heights = model.predict(run, model.at_prior())[:, 0].numpy()
    return heights, {p.name: p.value for p in model.base}


def frequency_hz(heights):
    """From the crossings of the mean of whole swings, 10 ms apart."""
    z = heights - heights[-40:].mean()
    k = np.flatnonzero((z[:-1] < 0.0) & (z[1:] >= 0.0))
    at = 0.01 * (k + z[k] / (z[k] - z[k + 1]))
    return (len(at) - 1) / (at[-1] - at[0])


def test_frequency_is_that_of_a_cantilever_with_a_tip_mass():
    """Rayleigh's quotient with Timoshenko's stiffness and 33/140 of the bar's mass at the tip."""
    heights, base = swing((6, 2, 2))
    inertia = BAR.width_m * BAR.height_m**3 / 12.0
    area = BAR.width_m * BAR.height_m
    young = base["youngs_modulus"]
    compliance = BAR.length_m**3 / (3.0 * young * inertia)
    compliance += BAR.length_m * 2.0 * (1.0 + NU) / (0.85 * young * area)
    mass = LOAD_KG + 33.0 / 140.0 * base["density"] * area * BAR.length_m
    expected = np.sqrt(1.0 / (compliance * mass)) / (2.0 * np.pi)
    # the weight stands 15 mm over the axis, and gravity pulls along a bent bar: a few percent
    assert frequency_hz(heights) == pytest.approx(expected, rel=0.04)


def test_every_mesh_swings_alike():
    """Calibrated, of the difference that locking makes between meshes little is left."""
    coarse, fine = swing((4, 1, 1))[0], swing((8, 2, 2))[0]
    softness = [
        bending_softness(BeamTip(BAR, HEIGHT, c, 5e-3, 1e-8, "bdf2", NU), BAR, NU)
        for c in ((4, 1, 1), (8, 2, 2))
    ]
    locking = np.sqrt(softness[1] / softness[0]) - 1.0
    assert locking > 0.1
    assert abs(frequency_hz(coarse) / frequency_hz(fine) - 1.0) < 0.2 * locking


def test_it_starts_where_the_run_says():
    heights, _ = swing((4, 2, 2), load_kg=0.0)
    rest = heights[-40:].mean()
    assert heights[0] - rest == pytest.approx(SWING_M, rel=0.15)
    assert np.abs(heights[1:] - rest).max() < heights[0] - rest


def test_softness_tends_to_one():
    meshes = [(4, 1, 1), (8, 2, 2), (16, 4, 4)]
    found = [
        bending_softness(BeamTip(BAR, HEIGHT, c, 5e-3, 1e-8, "bdf2", NU), BAR, NU) for c in meshes
    ]
    assert found[0] < found[1] < found[2] < 1.02
    assert found[2] > 0.8
