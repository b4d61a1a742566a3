"""Payloads of MuJoCo models: which bodies may carry one, and that it is a point mass there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffsim.cli.diagnose_inputs import choose
from diffsim.identify.model import Parameter
from diffsim.identify.model_file import SavedModel, effects_of
from diffsim.systems.description import EffectChoice, chosen_effects
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.setup import outside_setup
from tests.systems.outside import scenes

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.8"/>
      <body name="fore" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        {shape}
        {load}
      </body>
    </body>
  </worldbody>
  <actuator><position name="m" joint="elbow" kp="3"/></actuator>
  <sensor><jointpos name="a" joint="shoulder"/><jointpos name="b" joint="elbow"/></sensor>
</mujoco>
"""
ROD = '<geom type="capsule" fromto="0 0 0 0.24 0 0" size="0.01" mass="0.4"/>'
BARE = '<inertial mass="0.4" pos="0.1 0 0" diaginertia="0.0001 0.002 0.002"/>'
HAND = ROD + '<body name="hand" pos="0.3 0 0"><geom type="sphere" size="0.05" mass="0.2"/></body>'
BOX = '<geom type="box" pos="0.1 0 0" size="0.1 0.02 0.02" mass="0.4"/>'
LOAD = '<body pos="{} 0 0"><inertial mass="0.25" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/></body>'
CHANNELS = {"angle_rad": "a", "rate_rad_s": "b"}


def simulate(shape, load="", parameters=None):
    sim = Mjcf(ARM.format(shape=shape, load=load), CHANNELS)
    return sim.predict(parameters or {}, scenes.run_of("steps"))


@pytest.mark.parametrize(
    ("shape", "share", "place"),
    [(ROD, None, 0.24), (ROD, 0.5, 0.12), (BARE, None, 0.2), (HAND, None, 0.35), (BOX, 1.0, 0.2)],
)
def test_a_payload_is_a_point_mass_on_the_way_from_joint_to_far_end(shape, share, place):
    """The far end is where shapes end, of all that is fixed to the body; without shapes twice as
    far as the center of mass."""
    given = {"body.fore.payload": 0.25} | ({} if share is None else {"body.fore.payload_at": share})
    heavier = simulate(shape, parameters=given)
    assert np.abs(heavier - simulate(shape)).max() > 0.05, "the payload shows"
    # the load of the file has a moment of inertia of its own, 1e-6 of the arm's
    np.testing.assert_allclose(heavier, simulate(shape, LOAD.format(place)), atol=1e-4)


def test_a_payload_is_forgotten_after_each_call():
    sim, run = Mjcf(ARM.format(shape=ROD, load=""), CHANNELS), scenes.run_of("sine")
    before = sim.predict({}, run)
    sim.predict({"body.fore.payload": 0.25, "body.fore.mass": 0.5}, run)
    np.testing.assert_array_equal(sim.predict({}, run), before)
    with pytest.raises(ValueError, match=r"body\.fore\.payload must be at least 0, got -0\.1"):
        sim.predict({"body.fore.payload": -0.1}, run)


def test_places_that_were_those_of_the_inertia_stay_where_they_are():
    """A sensor of the rod's middle, which was its center of mass, reads the middle still."""
    text = ARM.format(shape=ROD + '<site name="middle" pos="0.12 0 0"/>', load="{}").replace(
        "</sensor>", '<framepos name="at" objtype="site" objname="middle"/></sensor>'
    )
    channels, run = {"angle_rad": "at[0]", "rate_rad_s": "at[2]"}, scenes.run_of("steps")
    heavier = Mjcf(text.format(""), channels).predict({"body.fore.payload": 0.25}, run)
    stated = Mjcf(text.format(LOAD.format(0.24)), channels).predict({}, run)
    np.testing.assert_allclose(heavier, stated, atol=1e-4)  # as above


def test_an_unbalance_moves_the_center_of_mass_and_nothing_else():
    given = {"body.fore.unbalance[0]": 0.4 * 0.03, "body.fore.unbalance[2]": -0.4 * 0.05}
    moved = simulate(BARE, parameters=given)
    assert np.abs(moved - simulate(BARE)).max() > 0.05, "it shows"
    stated = simulate(BARE.replace('pos="0.1 0 0"', 'pos="0.13 0 -0.05"'))
    np.testing.assert_allclose(moved, stated, atol=1e-9)


def test_an_unbalance_is_that_of_the_body_with_its_payload():
    """A tool beside the line from joint to far end: its mass, and its mass times the way."""
    sim = Mjcf(ARM.format(shape=BARE, load=""), CHANNELS)
    text, _ = sim.restated({"body.fore.payload": 0.1, "body.fore.unbalance[1]": 0.1 * 0.06})
    fore = mujoco.MjModel.from_xml_string(text).body("fore")
    assert fore.mass[0] == pytest.approx(0.5)
    center = [(0.4 * 0.1 + 0.1 * 0.2) / 0.5, 0.1 * 0.06 / 0.5, 0.0]
    np.testing.assert_allclose(fore.ipos, center, atol=1e-6)  # the file holds some digits
    with pytest.raises(ValueError, match=r"name one entry, such as body\.fore\.unbalance\[0\]"):
        sim.predict({"body.fore.unbalance": 0.1}, scenes.run_of("sine"))


def test_a_body_whose_center_mujoco_holds_carries_nothing():
    text = ARM.format(shape='<geom type="sphere" size="0.05" mass="0.4"/>', load="").replace(
        'name="elbow" axis="0 1 0"', 'name="elbow" type="slide" axis="0 1 0"'
    )
    sim = Mjcf(text, CHANNELS)
    given = {"body.fore.payload": 0.1}
    assert np.isfinite(sim.predict(given, scenes.run_of("sine"))).all()  # at its center of mass


def body(name, joint="hinge", inside=""):
    return (
        f'<body name="{name}" pos="0.1 0 0"><joint type="{joint}"/>'
        f'<geom type="box" size="0.1 0.02 0.02" pos="0.1 0 0" mass="1"/>{inside}</body>'
    )


@pytest.mark.parametrize(
    ("bodies", "carriers"),
    [
        (body("upper", inside=body("fore")), ["fore"]),
        (body("left") + body("right"), ["left", "right"]),
        (body("arm", inside=body("hand", inside=body("finger_1") + body("finger_2"))), ["hand"]),
        (body("chassis", "free", body("wheel_1") + body("wheel_2")), ["chassis"]),
        (body("cart", "slide", body("pole")), ["pole"]),
        (f'<body name="fixed">{body("finger_1")}{body("finger_2")}</body>', []),
        ("".join(body(f"pendulum_{k}") for k in range(9)), []),  # nobody can say which
    ],
)
def test_bodies_that_end_a_chain_may_carry_something(bodies, carriers):
    text = f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    assert list(Mjcf(text).carriers) == carriers


def test_causes_and_their_places_are_spelled_as_the_file_does():
    """A file of an earlier version, with places in small letters, is read as well."""
    text = ARM.format(shape=ROD, load="").replace('"fore"', '"FR_calf"')
    sim = Mjcf(text, CHANNELS, {"moment_Nm": "m"})
    setup = outside_setup(scenes.recorded(), sim, {})
    assert {"payload_at_FR_calf", "unbalance_at_FR_calf"} <= {e.name for e in setup.effects}
    old = SavedModel(Path("old"), {}, {}, (), ("payload_at_fr_calf",))
    assert [e.name for e in effects_of(old, setup.effects)] == ["payload_at_fr_calf"]
    twice = [*setup.effects, *(replace(e, name=e.name.swapcase()) for e in setup.effects)]
    with pytest.raises(ValueError, match="did you mean 'payload_at_FR_calf'"):
        effects_of(old, twice)


def test_a_study_of_before_may_spell_places_in_small_letters():
    """Its names are taken where they can mean one cause alone."""
    text = ARM.format(shape=ROD, load="").replace('"fore"', '"FR_calf"')
    library = outside_setup(scenes.recorded(), Mjcf(text, CHANNELS, {"moment_Nm": "m"}), {}).effects
    small, whole = "payload_at_fr_calf", "payload_at_FR_calf"
    (payload,) = chosen_effects(library, EffectChoice(only=(small,), typical={small: 0.3}))
    assert (payload.name, payload.typical) == (whole, 0.3)
    left = chosen_effects(library, EffectChoice(without=(small,)))
    assert {e.name for e in library} - {e.name for e in left} == {whole}
    assert [e.name for e in choose(library, [small])] == [whole]
    other = replace(payload, name="payload_at_Fr_Calf")
    for choice in ({"only": (small,)}, {"without": (small,)}, {"typical": {small: 0.3}}):
        with pytest.raises(ValueError, match=f"no cause '{small}'; did you mean .*{whole}"):
            chosen_effects((*library, other), EffectChoice(**choice))
    both = (*library, other, replace(payload, name=small))
    assert [e.name for e in chosen_effects(both, EffectChoice(only=(small,)))] == [small]


def test_a_payload_is_a_cause_unless_it_is_a_parameter():
    study = scenes.recorded()
    sim = Mjcf(ARM.format(shape=ROD, load=""), CHANNELS, {"moment_Nm": "m"})
    setup = outside_setup(study, sim, {})
    (payload,) = [e for e in setup.effects if e.family.startswith("load")]
    (unbalance,) = [e for e in setup.effects if e.family.startswith("unbalance")]
    assert unbalance.name == "unbalance_at_fore" and unbalance.components == ("x", "y", "z")
    # three tenths of the mass of 0.4 kg, by 0.24 m from joint to far end
    assert unbalance.typical == pytest.approx(0.3 * 0.4 * 0.24)
    assert payload.name == "payload_at_fore" and not payload.signed
    run, model = study.runs[0], setup.model
    scene = model.scene(run, model.at_prior(), {payload: model.at_prior().new_tensor([0.25])})
    want = sim.predict({"body.fore.payload": 0.25}, run)
    np.testing.assert_array_equal(scene.simulate().numpy(), want)
    known = outside_setup(study, sim, [Parameter("body.fore.payload", 0.1, 0.05, "kg")])
    assert not [e for e in known.effects if e.family.startswith("load")]
