"""What enters a store is a flow: its area divides it, its unit and its usual size go with that."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from diffsim.data.study_file import load_study
from diffsim.systems.registry import setup_of

FILE = Path(__file__).parents[2] / "studies" / "ode_stores" / "study.yaml"
AREA = 0.06  # m^2


def causes_of(area: str | None):
    """Causes at the upper tank by name, and what a usual size of each does to the first run."""
    study = load_study(FILE)
    first = {} if area is None else {"area": area}
    stores = [{**s, **first} for s in study.model["stores"]]
    study = replace(study, model={**study.model, "stores": stores})
    setup = setup_of(study)
    causes = {e.name: e for e in setup.effects if e.name.endswith("_of_upper_tank")}
    at = setup.model.at_prior()
    moved = {
        name: setup.model.predict(
            study.runs[0], at, {e: torch.tensor([e.typical], dtype=torch.float64)}
        ).numpy()
        for name, e in causes.items()
    }
    return causes, moved


@pytest.mark.reference
def test_a_flow_is_divided_by_the_area_and_told_in_its_unit():
    (plain, moved), (wide, as_much) = causes_of(None), causes_of(str(AREA))
    units = {
        "linear_leak_of_upper_tank": ("1/s", "m^2/s"),
        "root_outflow_of_upper_tank": ("(m)^0.5/s", "m^2.5/s"),
        "extra_inflow_of_upper_tank": ("m/s", "m^3/s"),
    }
    assert units.keys() <= plain.keys()
    for name, (rate, flow) in units.items():
        assert (plain[name].unit, wide[name].unit) == (rate, flow)
        assert wide[name].typical == pytest.approx(AREA * plain[name].typical)
    assert wide["overflow_of_upper_tank"].unit == "m"
    for name, record in moved.items():  # the same flow over its area, the same level
        np.testing.assert_allclose(as_much[name], record, rtol=1e-9, atol=1e-12)
