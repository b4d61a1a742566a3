"""The soft-beam laboratory against closed forms, another discretization and finer steps."""

from functools import partial

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import labs.virtual.soft_beam as soft_beam
from labs.virtual import SoftBeamLab
from labs.virtual.beam_modes import BeamShape, beam_modes
from labs.virtual.common import Plan
from tests.labs.truths import exact

pytestmark = pytest.mark.reference
STILL = {"marker_place_m": np.zeros(2), "zero_seed": 0}
TIP_M = soft_beam.MARKERS_M["tip_y_m"]


@pytest.fixture(scope="module")
def lab():
    return SoftBeamLab()


def measure(lab, command, *, youngs=None, beta=None, **effects):
    """Tip [m] without the zero error."""
    truth = exact(lab, STILL, **effects)
    truth["base"]["youngs_modulus"] = youngs or truth["base"]["youngs_modulus"]
    truth["base"]["rayleigh_beta"] = truth["base"]["rayleigh_beta"] if beta is None else beta
    t = np.arange(len(command)) / soft_beam.RATE_HZ
    out, _ = lab.measure(Plan("r", "g", "fit", t, {"tendon_N": np.asarray(command)}), truth)
    zero = np.random.default_rng([0, 0]).normal(0.0, 0.1e-3, 2)
    return (out - zero)[:, 0]


def released(num=300):
    """Held at 1 N, let go within a sample at 0.1 s."""
    return np.where(np.arange(num) < 10, 1.0, 0.0)


def peaks(tip):
    from scipy.signal import find_peaks

    at = find_peaks(np.abs(tip[11:]))[0] + 11
    return np.abs(tip[at])


def test_static_tip_under_a_moment(lab):
    tip = measure(lab, np.ones(5))[-1]
    expected = soft_beam.TENDON_OFFSET_M * TIP_M**2 / (2 * 280e3 * lab.shape.inertia)
    # pure bending: no shear; twelve modes of an infinite series
    assert tip == pytest.approx(expected, rel=6e-3)


def exact_frequency(shape, youngs, near):
    """Of Timoshenko's equations: place, slope, moment and shear carried along by an exponential."""
    shear = youngs / 2.0 * 10 / 12 * shape.area  # nu = 0
    mass, rotary = 1070.0 * shape.area, 1070.0 * shape.inertia

    def free_end(w):
        rates = [
            [0.0, 1.0, 0.0, 1.0 / shear],
            [0.0, 0.0, 1.0 / (youngs * shape.inertia), 0.0],
            [0.0, -rotary * w**2, 0.0, -1.0],
            [-mass * w**2, 0.0, 0.0, 0.0],
        ]
        return np.linalg.det(expm(np.array(rates) * shape.length)[2:, 2:])

    return brentq(free_end, 0.97 * near, 1.03 * near)


def test_frequencies_against_the_exact_ones():
    shape = BeamShape()
    for i, w in enumerate(beam_modes(shape, 280e3, num_modes=6).omega):
        # second order: wave number times cell, squared, over the 24 of each central difference
        tolerance = 3.0 * ((i + 0.6) * np.pi / shape.num_cells) ** 2 / 24.0
        assert w == pytest.approx(exact_frequency(shape, 280e3, w), rel=tolerance)


def test_frequencies_converge_in_second_order():
    n = np.array([20, 40, 80])
    first = np.array([beam_modes(BeamShape(num_cells=int(k)), 280e3).omega[1] for k in (*n, 640)])
    error = np.abs(first[:3] - first[3])
    assert np.polyfit(np.log(1 / n), np.log(error), 1)[0] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(
    ("effects", "rate"),
    [
        ({"beta": 1.5e-3}, lambda w, share: 0.5 * 1.5e-3 * w**2),
        ({"beta": 0.0, "stiffness_damping": 1e-3}, lambda w, share: 0.5 * 1e-3 * w**2),
        ({"beta": 0.0, "volume_drag": 2e3}, lambda w, share: 0.5 * 2e3 / 1070.0 * share),
    ],
)
def test_decay_rate(lab, effects, rate):
    """The free vibration is a sum of modes that decay as they should."""
    tip = measure(lab, released(), **effects)
    t = np.arange(300) / 100.0
    late = t > 0.12
    modes = []
    shapes = beam_modes(lab.shape, 280e3)
    # rotary inertia feels no drag: share of the modal mass that does
    shares = 1070.0 * (shapes.deflection**2 * shapes.node_volume[:, None]).sum(axis=0)
    assert 0.95 < shares[0] < 1.0
    for w, share in zip(shapes.omega[:4], shares, strict=False):
        decay = rate(w, share)
        ringing = np.sqrt(complex(w**2 - decay**2))  # imaginary where overdamped
        wave = np.exp((-decay + 1j * ringing) * (t[late] - 0.1))
        modes += [wave.real, wave.imag]
    basis = np.column_stack(modes)
    fit, *_ = np.linalg.lstsq(basis, tip[late], rcond=None)
    left = tip[late] - basis @ fit
    assert left.std() < 0.01 * tip[late].std()  # with rates 5 % off: above 1.5 %


def test_loss_factor_is_the_same_at_all_frequencies():
    """Imaginary over real part of one mode's stiffness; none under a load that lasts."""
    omega, loss = 1.0, 0.03
    rates = soft_beam._mode_rates(omega, 0.0, loss)
    for hz in (2.0, 6.0, 20.0):
        s = 2j * np.pi * hz
        branches = rates[1, 2:] @ np.linalg.solve(s * np.eye(11) - rates[2:, 2:], rates[2:, 0])
        stiffness = -(rates[1, 0] + branches)
        assert stiffness.imag / stiffness.real == pytest.approx(loss, rel=0.2)
    still = -(rates[1, 0] + rates[1, 2:].sum())  # branches relaxed
    assert still == pytest.approx(omega**2)


@pytest.fixture
def one_mode(monkeypatch):
    """Only the first mode: a single oscillator, whose closed forms are known."""
    first = partial(beam_modes, num_modes=1)
    monkeypatch.setattr(soft_beam, "beam_modes", first)
    return first(BeamShape(), 280e3)


def test_dry_friction_against_the_coulomb_oscillator(lab, one_mode):
    tip = measure(lab, released(), beta=0.0, dry_friction=2e-3)
    give = 2e-3 * one_mode.deflection[-1, 0] ** 2 / one_mode.omega[0] ** 2  # F / k
    assert -np.diff(peaks(tip)[:3]).mean() == pytest.approx(2 * give, rel=0.1)  # sampled peaks
    assert np.abs(tip[-1]) <= give
    assert np.ptp(tip[-50:]) < 1e-12


def test_quadratic_drag_against_the_energy_balance(lab, one_mode):
    """1 / amplitude grows by 8 / 3 times drag / mass per swing (equivalent linearization)."""
    high = peaks(measure(lab, released(), beta=0.0, quadratic_volume_drag=5e4))
    shape = one_mode.deflection[:, 0] / one_mode.deflection[-1, 0]
    drag = 5e4 * (shape**3 * one_mode.node_volume).sum()
    mass = 1.0 / one_mode.deflection[-1, 0] ** 2
    growth = np.polyfit(np.arange(len(high[:20])), 1.0 / high[:20], 1)[0]
    assert growth == pytest.approx(4.0 / 3.0 * drag / mass, rel=0.1)


def test_added_mass_lowers_the_frequency():
    w0 = beam_modes(BeamShape(), 280e3).omega[0]
    w1 = beam_modes(BeamShape(), 280e3, added_density=300.0).omega[0]
    assert w1 / w0 == pytest.approx((1070.0 / 1370.0) ** 0.5, rel=5e-3)  # no rotary inertia


def test_delay_moves_the_response(lab):
    plain, late = (measure(lab, released(), delay=d) for d in (0.0, 0.02))
    np.testing.assert_allclose(late[2:], plain[:-2], atol=1e-9)


def test_tilt_against_the_uniformly_loaded_cantilever(lab):
    tip = measure(lab, np.zeros(300), beta=5e-3, tilt=0.5)[-1]
    shape = lab.shape
    load = 1070.0 * shape.area * 0.5
    shear = 280e3 / 2.0 * 10 / 12 * shape.area
    at, left = TIP_M, shape.length - TIP_M  # the marker is not quite at the end
    bent = at**2 * (6 * shape.length**2 - 4 * shape.length * at + at**2) / 24
    sheared = (shape.length**2 - left**2) / 2
    expected = load * (bent / (280e3 * shape.inertia) + sheared / shear)
    assert tip == pytest.approx(expected, rel=2e-3)


def test_stiffening_against_the_moment_curvature_law(lab):
    k = 300.0
    tip = [measure(lab, np.ones(300), beta=8e-3, stiffening=s)[-1] for s in (0.0, k)]
    shape, moment = lab.shape, soft_beam.TENDON_OFFSET_M
    depth4 = shape.width * shape.depth**5 / 80.0
    roots = np.roots([280e3 * k * depth4, 0.0, 280e3 * shape.inertia, -moment])
    curvature = float(roots[np.abs(roots.imag) < 1e-12].real[0])
    linear = moment / (280e3 * shape.inertia)
    assert tip[1] / tip[0] == pytest.approx(curvature / linear, rel=2e-3)


@pytest.mark.parametrize(
    ("effect", "size", "given", "expected"),
    [
        ("tension_dead_band", 0.1, [0.05, 0.3], [0.0, 0.2]),
        ("saturation", 0.2, [1.0, 1.5], [1.0, 1.28]),
        ("quantization", 0.1, [0.44, 0.46], [0.4, 0.5]),
        ("tension_backlash", 0.2, [0.5, 0.45], [0.5, 0.5]),
    ],
)
def test_static_actuator_laws(lab, effect, size, given, expected):
    for u, out in zip(given, expected, strict=True):
        command = np.full(20, u) if effect != "tension_backlash" else np.linspace(0.5, u, 20)
        t = np.arange(20) / 100.0
        plan = Plan("r", "g", "fit", t, {"tendon_N": command})
        tension = soft_beam._actuator(plan, exact(lab, STILL, **{effect: size}))
        assert tension[-1] == pytest.approx(out, abs=1e-12)


@pytest.mark.parametrize(
    "name", ["quadratic_volume_drag", "stiffening", "dry_friction", "stop", "lag"]
)
def test_finer_steps_change_less_than_a_tenth_of_the_noise(lab, name, monkeypatch):
    command = lab.plans(np.random.default_rng(0))[1].command["tendon_N"]
    coarse = measure(lab, command, **{name: lab.effects[name].typical})
    monkeypatch.setattr(soft_beam, "SUBSTEPS", 80)
    fine = measure(lab, command, **{name: lab.effects[name].typical})
    assert np.abs(coarse - fine).max() < 0.1 * soft_beam.SD_M


@pytest.fixture(scope="module")
def null(lab):
    return lab(1)


@pytest.mark.slow
def test_effects_are_off_at_zero(lab, null):
    off = lab.case(1, dict.fromkeys(lab.effects, 0.0)).study
    for a, b in zip(null.runs, off.runs, strict=True):
        np.testing.assert_array_equal(a.measured, b.measured)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SoftBeamLab.effects))
def test_every_effect_shows(lab, null, name):
    """Over all samples together, ten noise sd, before anything is refitted to it."""
    runs = zip(null.runs, lab(1, name).runs, strict=True)
    change = np.concatenate([(a.measured - b.measured).ravel() for a, b in runs])
    assert np.sqrt(np.nansum(change**2)) > 10.0 * soft_beam.SD_M
