"""Do the stories of multicopters end as told?"""

import pytest

from tests.examples.stories import load_story

pytestmark = pytest.mark.example


def test_all_designs_fly_to_the_target(tmp_path):
    story = load_story("copter/designs.py")
    numbers = story.main()
    assert len(numbers) == 7
    for name, row in numbers.items():
        assert row["arrival within 0.1 m [s]"] < 6.0, name
        assert row["distance at the end [mm]"] < 20.0, name
        assert row["largest share of a rotor in hover [%]"] < 100.0, name
    lift = "largest overall weight [g]"
    flat, twin = numbers["pentacopter"], numbers["pentacopter_payload"]
    assert twin[lift] / flat[lift] == pytest.approx(1.249, abs=0.001)
    life = "battery life [min]"
    square, long = numbers["quadcopter"], numbers["quadcopter_flight_time"]
    assert long[life] > 1.1 * square[life]
    assert numbers["bunny"][life] != numbers["bunny"][life]  # not a number: never measured


def test_picture_and_fabrication(tmp_path):
    story = load_story("copter/designs.py")
    story.main(("x_quadcopter",), 1.0, str(tmp_path), fabricate=True)
    assert (tmp_path / "x_quadcopter.png").stat().st_size > 10_000
    assert (tmp_path / "x_quadcopter_parts.png").stat().st_size > 10_000
    assert (tmp_path / "x_quadcopter_fabrication" / "stl" / "frame.stl").is_file()


def test_table_3_1_from_one_start():
    pytest.importorskip("cvxpy")
    numbers = load_story("copter/table31.py").main(1)
    assert 20.0 < numbers["gain [%]"] < 25.0
    assert numbers["gain of tilt alone [%]"] < numbers["gain [%]"]


def test_a_sweep_costs_payload_and_goes_on_where_it_was(tmp_path, capsys):
    pytest.importorskip("cvxpy")
    story = load_story("copter/payload_by_authority.py")
    rows = story.main(["--out", str(tmp_path), "--torques", "0", "0.5"])
    assert [row["weight_N"] for row in rows] == pytest.approx([58.36, 56.72], abs=0.02)
    story.largest_weight = None  # is not called again
    assert story.main(["--out", str(tmp_path), "--torques", "0", "0.5"]) == rows


@pytest.mark.slow
def test_both_together_fly_nearer_to_waypoints():
    numbers = load_story("copter/hexarotor.py").main(["--evaluations", "80"])
    plain, alone, both = (v for k, v in numbers.items() if "unseen" not in k)
    assert plain == pytest.approx(1.362, abs=0.001)
    assert both < 0.95 * alone < 0.9 * plain


@pytest.mark.slow
def test_the_largest_propellers_are_on_the_front_where_there_is_room(tmp_path):
    pytest.importorskip("cvxpy")
    story = load_story("copter/catalog.py")
    found = story.main(
        ["--out", str(tmp_path), "--rotor", "kde2814_10in", "kde2814_14in", "rx2206_gemfan5045x3"]
    )
    assert {choice.rotor for choice in found.choices} == {"kde2814_14in"}
    assert len(found.solved) + len(found.pruned) + len(found.failed) == 81
    assert len(found.pruned) > 50
    assert (tmp_path / "front.png").stat().st_size > 5_000
