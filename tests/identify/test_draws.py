"""Draws of a saved model: as wide as the intervals that the answer states, not as its fit alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from diffsim.identify.model import Parameter
from diffsim.identify.model_file import SavedModel
from diffsim.identify.ranges import SURE_SD, Range, range_of_number


def saved(**ranges: tuple[float, float]) -> SavedModel:
    values = {"mass": 2.0, "delay": 0.02, "wind": -1.0}
    return SavedModel(
        Path("m.yaml"),
        values,
        dict.fromkeys(values, 1e-3),
        ("mass",),
        ("delay", "wind"),
        correlation={"delay": {"mass": 0.8}},
        ranges={name: Range(values[name], *ends) for name, ends in ranges.items()},
    )


def drawn(model: SavedModel, *names: str) -> np.ndarray:
    """Values in their units, (20000, num_names)."""
    return model.draw(names, 20_000, fresh()).numpy()


def fresh() -> np.random.Generator:
    return np.random.default_rng(0)


def test_ends_of_draws_are_those_of_the_answer() -> None:
    model = saved(mass=(1.9, 2.3), wind=(-1.5, -0.9))
    found = drawn(model, "mass", "wind", "delay")
    low, middle, high = np.quantile(found, (0.05, 0.5, 0.95), axis=0)
    np.testing.assert_allclose(low[:2], (1.9, -1.5), atol=0.015)
    np.testing.assert_allclose(high[:2], (2.3, -0.9), atol=0.015)
    np.testing.assert_allclose(middle, (2.0, -1.0, 0.02), atol=0.01)
    np.testing.assert_allclose((high - low)[2], 2 * 1.645e-3, rtol=0.03)  # the fit's: none stated
    assert 0.75 < np.corrcoef(found[:, 0], found[:, 2])[0, 1] < 0.85


def test_no_draw_changes_the_sign_of_an_interval() -> None:
    found = drawn(saved(delay=(0.005, 0.04), wind=(-3.0, -0.01)), "delay", "wind")
    assert found[:, 0].min() >= 0.0 and found[:, 1].max() <= 1e-15
    both = drawn(saved(delay=(-0.01, 0.04)), "delay")
    assert both.min() < 0.0


def test_draws_of_negative_numbers_keep_their_correlation() -> None:
    model = replace(saved(wind=(-3.0, -0.4)), correlation={"wind": {"mass": 0.8}})
    found = drawn(model, "mass", "wind")
    assert np.corrcoef(found[:, 0], -np.log(-found[:, 1]))[0, 1] > 0.75


def test_numbers_without_a_sign_are_never_below_zero() -> None:
    found = drawn(saved(delay=(0.0, 0.04)), "delay")
    assert found.min() == 0.0
    np.testing.assert_allclose(np.quantile(found, 0.95), 0.04, rtol=0.03)


def test_coordinates_of_draws_lead_back_to_the_draws() -> None:
    model = saved(mass=(1.9, 2.3), delay=(0.01, 0.05))
    base = [Parameter("mass", 2.1, 0.1, "kg", log=True), Parameter("delay", 0.02, 0.01, "s")]
    at = model.draw_coordinates(base, 500, fresh())
    back = torch.stack([p.value_at(at[:, k]) for k, p in enumerate(base)], 1)
    torch.testing.assert_close(back, model.draw(("mass", "delay"), 500, fresh()))


def test_what_the_file_does_not_know_is_drawn_from_its_prior() -> None:
    at = saved().draw_coordinates([Parameter("offset@new", 5.0, 0.5, "m")], 20_000, fresh())
    assert abs(float(at.mean())) < 0.03 and abs(float(at.std()) - 1.0) < 0.03


def test_the_farthest_draw_is_told() -> None:
    model = saved(delay=(0.01, 0.05))
    most = float(range_of_number(model, "delay").drawn(torch.tensor(SURE_SD, dtype=torch.float64)))
    assert drawn(model, "delay").max() <= most
