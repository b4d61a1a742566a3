"""The page of a flight: the vehicle stands where the log says, and the page stays small."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffsim.copter import load_design
from diffsim.copter.simulator import load_mission
from diffsim.copter.simulator.flight_simulator import FlightSimulator
from diffsim.viz.flight_page import flight_page, moving_vehicle
from diffsim.viz.moving import Line
from diffsim.viz.report import write
from tests.browser import CHROMIUM, Browser
from tests.optional import needs

needs("plotly", reason="pages need pip install -e '.[viz]'")
needs("jinja2", reason="pages need pip install -e '.[viz]'")

pytestmark = pytest.mark.serial  # a browser draws the pages


@pytest.fixture(scope="module")
def design():
    return load_design("pentacopter")


@pytest.fixture(scope="module")
def log(design):
    simulator = FlightSimulator(design)
    simulator.run(load_mission("there_and_back"), seconds=3.0)
    return simulator.log


def test_parts_stand_where_the_log_says(log, design):
    view = moving_vehicle(log, design)
    frame, *propellers = [part for part in view.parts if not isinstance(part, Line)]
    assert frame.name == "frame" and len(propellers) == 5
    at = int(np.argmin(np.abs(log.series("time") - view.time_s[40])))
    sample = log.samples[at]
    up = np.diag([1.0, -1.0, -1.0])
    body = up @ Rotation.from_quat(sample.quaternion[[1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(frame.turns[40], body, atol=1e-12)
    np.testing.assert_allclose(frame.places_m[40], up @ sample.position, atol=1e-12)
    vehicle = design.multicopter().detach()
    for k, part in enumerate(propellers):
        hub = up @ sample.position + body @ vehicle.positions[k].numpy()
        np.testing.assert_allclose(part.places_m[40], hub, atol=1e-12)
        # a propeller turns about its thrust alone, against its reaction torque
        axis = vehicle.directions[k].numpy()
        np.testing.assert_allclose(part.turns[40] @ axis, body @ axis, atol=1e-9)
        between = Rotation.from_matrix(body.T @ part.turns[40] @ (body.T @ part.turns[39]).T)
        assert np.sign(between.as_rotvec() @ axis) == -np.sign(float(vehicle.spins[k]))


def test_the_page(log, design, tmp_path):
    shown = flight_page(log, design, payload=0.5)
    assert shown.subtitle.endswith("with 0.5 kg") and "RMS" in shown.verdict[0]
    path = write(flight_page(log, design), tmp_path / "flight.html")
    assert path.stat().st_size < 3_000_000
    if CHROMIUM is None:
        pytest.skip("no chromium here")
    with Browser(tmp_path / "profile") as browser:
        browser.open(path)
        browser.until("document.querySelectorAll('.legendtoggle').length > 5")
        assert int(browser.js("document.querySelector('.moving').dataset.drawn")) > 1000
        assert browser.complaints == []
