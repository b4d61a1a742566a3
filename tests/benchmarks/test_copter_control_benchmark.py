"""The benchmark of the multicopter's control layers runs, and its gradients are right."""

from benchmarks.copter_control import measure


def test_gradients_and_rows():
    result = measure(6, seconds=0.0)
    # differences of fourth order reach 1e-11 (hover) and 1e-10 (LQR) at the steps taken
    assert result["hover_gradient_error"] < 1e-9
    assert result["lqr_gradient_error"] < 1e-8
    assert result["lqr_difference_from_scipy"] < 1e-10
    assert all(row["median"] > 0.0 for row in result["milliseconds"].values())
