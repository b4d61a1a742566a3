"""The shortest examples: each against a closed form, or against its own statement."""

import pytest
import torch

from diffsim.mesh import nodal_volume
from tests.examples.stories import load_story

pytestmark = pytest.mark.example


def test_a_bar_sags_in_inverse_proportion_to_its_modulus():
    found = load_story("softbody/cantilever.py").main(cells=(10, 2, 2))
    assert found["relative slope"] == pytest.approx(-1.0, abs=0.01)  # -1 for small sags


def test_the_modulus_is_found_again():
    found = load_story("softbody/stiffness_from_motion.py").main()
    assert found["modulus kPa"] == pytest.approx(300.0, rel=1e-4)


def test_a_shaped_finger_lifts_more_on_a_finer_mesh_too():
    found = load_story("softbody/shape.py").main("lift", 1, 8, evolution=False)
    assert found["gradient coarse"] > found["plain coarse"] + 5.0  # mm
    assert found["gradient fine"] > found["plain fine"] + 5.0


def test_a_shaped_finger_holds_more_on_a_finer_mesh_too():
    found = load_story("softbody/shape.py").main("hold", 1, 8, evolution=False)
    assert found["gradient coarse"] > 1.5 * found["plain coarse"]
    assert found["gradient fine"] > 1.5 * found["plain fine"]


def test_long_steps_around_a_peg_are_nearly_equilibria():
    story = load_story("softbody/shape.py")
    plain = torch.zeros(3 * story.STATIONS, dtype=torch.float64)
    held = [kind((10, 2, 2)).gain(plain).item() for kind in (story.Gripper, story.RestingGripper)]
    assert held[1] == pytest.approx(held[0], rel=0.02)


def test_a_fish_swims_faster_with_its_shape_and_every_result_is_kept(tmp_path):
    story = load_story("softbody/shape_swimmer.py")
    found = story.main(out=str(tmp_path), **story.QUICK)
    cage, controller = (found[f"{arm}_0"]["speeds"]["coarse"] for arm in ("cage", "controller"))
    assert cage > controller + 10.0 > 40.0  # mm/s; a network that has not learned: below 3
    fish, numbers = story.Fish(story.COARSE), torch.tensor(found["cage_0"]["numbers"]).double()
    shape = fish.shape(numbers[sum(story.SIZES) :].reshape(3, -1))
    assert (shape - fish.mesh.x_rest).abs().max() > 2e-3  # m
    assert torch.equal(fish.swim(numbers, 0.1)[0][0], shape)  # where it begins, at rest
    assert float(nodal_volume(fish.mesh, shape).sum()) == pytest.approx(float(fish.volume))
    assert story.main(out=str(tmp_path), **story.QUICK) == found
    assert "cage - controller" in story.table(found)


def test_coulomb_friction_stops_the_block():
    found = load_story("contact/sliding_block.py").main()
    # the last step ends where the speed changes sign: up to v dt = 6 mm of 204 mm
    assert found["distance m"] == pytest.approx(found["closed form m"], rel=0.03)
    assert found["slope m"] == pytest.approx(found["closed form slope m"], rel=0.03)


def test_poiseuilles_law_and_its_slope():
    found = load_story("stokes/channel.py").main()
    # 25 cells across the channel, second order: 0.6 % and 0.3 % measured
    assert found["over closed form"] == pytest.approx(1.0, abs=0.01)
    assert found["slope over closed form"] == pytest.approx(1.0, abs=0.01)


def test_a_step_against_the_gradient_lowers_the_thrust_as_predicted():
    found = load_story("copter/hover_gradient.py").main()
    assert found["predicted over true"] == pytest.approx(1.0, abs=0.01)


def test_a_payload_costs_current_not_place():
    found = load_story("copter/mission.py").main(seconds=1.0)
    assert found["loaded, current A"] > found["bare, current A"] + 1.0
    assert max(found["bare, error cm"], found["loaded, error cm"]) < 5.0


def test_tetrahedra_come_closer_to_the_solid():
    found = load_story("mesh/from_a_distance.py").main()
    assert abs(found["tetrahedra, 12.5 mm"]) < 0.4 * abs(found["tetrahedra, 25 mm"]) < 0.03


def test_a_chamber_lifts_the_block_as_its_gradient_says():
    found = load_story("softbody/pneumatic_block.py").main()
    assert 0.5 < found["rise mm"] < 3.0
    assert found["predicted over true"] == pytest.approx(1.0, abs=1e-3)


def test_the_weight_slows_the_beam_by_its_mass():
    story = load_story("data/ring_down.py")
    found = story.main()
    assert found["load52_a, frequency Hz"] < 0.7 * found["gravity_a, frequency Hz"]


def test_a_study_without_test_runs_is_warned_of():
    found = load_story("data/check_study.py").main()
    assert not any(p.severity == "error" for p in found["as recorded"])
    assert any("no run with use: test" in p.message for p in found["nothing held out"])


def test_one_factor_solves_before_and_after_new_values():
    found = load_story("linalg/sparse_solve.py").main(n=30)
    assert found["residual"] < 1e-12 and found["residual, new values"] < 1e-12
