"""Inertia that no body has, in every file of a vehicle: the entry, its limit, the likely slip."""

import math

import numpy as np
import pytest

from diffsim.copter import load_vehicle
from diffsim.core.inertia import inertia_matrix, inertia_mistake
from diffsim.data import load_study
from diffsim.systems.registry import setup_of

GOOD = (1.559, (0.00168, 0.0017, 0.001676), (0.0, 0.0, 0.0))
MISTAKES = {  # mass, moments, products; words of the sentence
    "power of ten": ((1.559, (0.00168, 0.0017, 1.676), (0.0,) * 3), ["izz", "1000 times"]),
    "slots": ((51.3, (2.24, -2240.0, 1.9), (0.1, 0.0, 0.0)), ["iyy", "above 0", "slot"]),
    "sign": ((0.8, (-0.0012, 0.0021, 0.0018), (0.0,) * 3), ["ixx", "above 0", "a sign"]),
    "triangle": ((0.05, (1.486e-6, 2e-7, 8.31e-7), (0.0,) * 3), ["ixx", "iyy", "ten times"]),
    "products": ((1.2, (0.011, 0.0001, 0.012), (0.02, 0.0, 0.0)), ["ixy", "ixx", "iyy", "slots"]),
    "products xz": ((1.2, (0.011, 0.012, 0.0001), (0.0, 0.02, 0.0)), ["ixz", "ixx", "izz"]),
    "products yz": ((1.2, (0.011, 0.012, 0.0001), (0.0, 0.0, 0.02)), ["iyz", "iyy", "izz"]),
    "turned": ((1.2, (0.02, 0.02, 0.02), (0.012, 0.012, -0.012)), ["principal", "signs"]),
    "unit": ((1.2, (11000.0, 12000.0, 20000.0), (0.0,) * 3), ["gyration", "kg mm^2"]),
    "grams": ((1200.0, (0.011, 0.012, 0.02), (0.0,) * 3), ["gyration", "mass in g"]),
    "no mass": ((0.0, (0.01, 0.01, 0.02), (0.0,) * 3), ["mass", "above 0"]),
    "not a number": ((1.2, (math.nan, 0.01, 0.02), (0.0,) * 3), ["finite"]),
}
VEHICLE = """body: FLU
{body}
rotors:
  - {{at: [0.15, -0.15, 0.02], spin: ccw}}
  - {{at: [-0.15, 0.15, 0.02], spin: ccw}}
  - {{at: [0.15, 0.15, 0.02], spin: cw}}
  - {{at: [-0.15, -0.15, 0.02], spin: cw}}
rotor: {{radius: 5 inch, max_thrust: 8 N, torque_ratio: 15 mm}}
"""
ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def urdf(mass, entries):
    stated = " ".join(f'{e}="{v}"' for e, v in zip(ENTRIES, entries, strict=True))
    inertial = f'<inertial><mass value="{mass}"/><inertia {stated}/></inertial>'
    return f'<robot name="q"><link name="base">{inertial}</link></robot>'


def mjcf(mass, entries):
    places = ((0.15, -0.15, 1), (-0.15, 0.15, 1), (0.15, 0.15, -1), (-0.15, -0.15, -1))
    sites = "".join(f'<site name="s{k}" pos="{x} {y} 0"/>' for k, (x, y, _) in enumerate(places))
    motors = "".join(
        f'<motor site="s{k}" gear="0 0 1 0 0 {0.015 * s}" ctrllimited="true" ctrlrange="0 8"/>'
        for k, (_, _, s) in enumerate(places)
    )
    stated = " ".join(str(v) for v in entries)
    return (
        f'<mujoco><worldbody><body name="q"><freejoint/><inertial mass="{mass}" pos="0 0 0" '
        f'fullinertia="{stated}"/>{sites}</body></worldbody><actuator>{motors}</actuator></mujoco>'
    )


def sdf(mass, entries):
    stated = "".join(f"<{e}>{v}</{e}>" for e, v in zip(ENTRIES, entries, strict=True))
    return (
        '<sdf version="1.9"><model name="q"><link name="base"><inertial>'
        f"<mass>{mass}</mass><inertia>{stated}</inertia></inertial></link></model></sdf>"
    )


def vehicle_file(folder, form, case):
    """The path of a vehicle whose mass and inertia a file of this form states."""
    mass, moments, products = case
    path = folder / "vehicle.yaml"
    if form == "yaml":
        numbers = ", ".join(".nan" if math.isnan(v) else str(v) for v in (*moments, *products))
        path.write_text(VEHICLE.format(body=f"mass: {mass}\ninertia: [{numbers}]"))
        return path
    pytest.importorskip("mujoco") if form != "sdf" else None
    body = folder / f"body.{'xml' if form == 'mjcf' else form}"
    body.write_text({"urdf": urdf, "mjcf": mjcf, "sdf": sdf}[form](mass, (*moments, *products)))
    path.write_text(VEHICLE.format(body=f"body_file: {body.name}"))
    return body if form == "mjcf" else path


@pytest.mark.parametrize("form", ["yaml", "urdf", "mjcf", "sdf"])
def test_what_no_body_has_is_named_in_every_file(tmp_path, form):
    for case, words in MISTAKES.values():
        with pytest.raises(ValueError, match=r".") as refused:
            load_vehicle(str(vehicle_file(tmp_path, form, case)))
        said = str(refused.value).lower()
        missing = [w for w in words if w not in said]
        # yaml's own reader names a number that is none, or not above 0, by its place
        assert not missing or (form == "yaml" and "inertia[0]" in said), (case, said)
    vehicle = load_vehicle(str(vehicle_file(tmp_path, form, GOOD))).vehicle
    assert float(vehicle.mass) == pytest.approx(1.559)


def test_every_body_of_points_is_possible():
    """Clouds of masses, down to plates and rods, which stand at the limits."""
    rng = np.random.default_rng(5)
    for shape in rng.choice([0.02, 1.0], size=(200, 3)):
        points, masses = rng.normal(size=(6, 3)) * shape, rng.uniform(0.1, 1.0, 6)
        points -= masses @ points / masses.sum()
        inertia = sum(
            m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points, strict=True)
        )
        entries = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        np.testing.assert_array_equal(inertia_matrix(entries), inertia)
        assert inertia_mistake(entries) is None


def test_studies_of_bodies_are_asked_too(tmp_path):
    (tmp_path / "a.csv").write_text("time_s,z\n" + "".join(f"{0.1 * k},{k}\n" for k in range(20)))
    (tmp_path / "study.yaml").write_text(
        """name: toss
model:
  system: rigid_body
  bodies: [{name: part, mass: 0.3, inertia: [1.0e-4, 1.2e-4, 9.0e-3]}]
  measures: [{body: part, position: {z: z}}]
channels: [{name: z, unit: m, sd: 0.001}]
runs: [{name: a, file: a.csv}]
"""
    )
    with pytest.raises(ValueError, match=r"inertia\[2\] must be at most"):
        setup_of(load_study(tmp_path / "study.yaml"))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("[[2.24, 0.1, 0], [0.1, -2240, 0], [0, 0, 1.9]]", r"inertia\[1\] \(iyy\) must be above 0"),
        ("[[0.02, 0.001, 0], [0.002, 0.02, 0], [0, 0, 0.03]]", "row 1, column 2 must equal row 2"),
        ("[[0.02, 0], [0, 0.02], 0.03]", r"inertia\[0\]: must be a number, got a list of 2"),
    ],
)
def test_a_matrix_of_a_vehicle_file_is_read_and_held_to_the_same(tmp_path, rows, said):
    """Each of its rows was said to be no number."""
    path = tmp_path / "q.yaml"
    path.write_text(VEHICLE.format(body=f"mass: 1.2\ninertia: {rows}"))
    with pytest.raises(ValueError, match=said):
        load_vehicle(str(path))
    good = "[[0.011, 0.001, 0], [0.001, 0.012, 0], [0, 0, 0.02]]"
    path.write_text(VEHICLE.format(body=f"mass: 1.2\ninertia: {good}"))
    inertia = load_vehicle(str(path)).vehicle.inertia
    sizes = sorted(abs(float(v)) for v in inertia.flatten())
    assert sizes == [0, 0, 0, 0, 0.001, 0.001, 0.011, 0.012, 0.02]
