"""Moving bodies in pages: what is packed is what was given, and a browser turns and plays it."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest

from diffsim import mesh
from diffsim.viz import charts, report
from diffsim.viz.frames import triangles
from diffsim.viz.moving import MAX_BYTES, Deforming, Line, Moving, Rigid
from tests.browser import CHROMIUM, Browser
from tests.optional import needs

needs("plotly", reason="pages need pip install -e '.[viz]'")
needs("jinja2", reason="pages need pip install -e '.[viz]'")

pytestmark = pytest.mark.serial  # a browser draws the pages


def bar(frames: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A bar that bends: triangles, and nodes over time."""
    solid = mesh.hex_box((6, 2, 2), (0.3, 0.06, 0.06))
    nodes = np.repeat(solid.nodes.numpy()[None], frames, 0)
    bend = np.linspace(0.0, 1.0, frames)[:, None]
    nodes[:, :, 2] -= bend * nodes[:, :, 0] ** 2
    surface = mesh.surface_quads(solid)
    return triangles(surface.faces.numpy()), nodes


def view() -> Moving:
    faces, nodes = bar()
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    ball = Rigid(
        name="ball </script>",
        color="#b3362a",
        triangles=faces,
        nodes_m=0.3 * nodes[0],
        turns=np.array([np.linalg.matrix_power(quarter, k) for k in range(5)]),
        places_m=np.linspace([0.0, 0.1, 0.1], [0.2, 0.1, 0.1], 5),
    )
    body = Deforming(name="bar", color="#0b6e75", triangles=faces, nodes_m=nodes)
    path = Line(name="path", color="#a86a0a", points_m=ball.places_m)
    return Moving(time_s=np.linspace(0.0, 0.4, 5), parts=[body, ball, path], caption="A bar bends.")


def unpacked(part: dict) -> np.ndarray:
    """Positions as the page's script computes them."""
    levels = np.frombuffer(base64.b64decode(part["levels"]), "<u2").reshape(-1, 3)
    return np.array(part["from"]) + levels / 65535 * np.array(part["size"])


def test_what_is_packed_is_what_was_given():
    given = view()
    packed = json.loads(given.html)
    for part, said in zip(given.parts, packed["parts"], strict=True):
        exact = (part.points_m if isinstance(part, Line) else part.nodes_m).reshape(-1, 3)
        span = np.ptp(exact, axis=0).max()
        np.testing.assert_allclose(unpacked(said), exact, atol=span / 65535)
    poses = np.frombuffer(base64.b64decode(packed["parts"][1]["poses"]), "<f4").reshape(-1, 12)
    np.testing.assert_allclose(poses[:, :9].reshape(-1, 3, 3), given.parts[1].turns)
    np.testing.assert_allclose(poses[:, 9:], given.parts[1].places_m, atol=1e-7)
    faces = np.frombuffer(base64.b64decode(packed["parts"][0]["triangles"]), "<u2")
    np.testing.assert_array_equal(faces.reshape(-1, 3), given.parts[0].triangles)
    assert "</script>" not in given.html


def test_the_box_holds_rigid_parts_however_they_are_turned():
    time = np.array([0.0, 1.0])
    corners = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    turns = np.stack([np.eye(3), np.diag([-1.0, 1.0, -1.0])])
    places = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    made = {"color": "#000000", "triangles": np.array([[0, 1, 2]]), "nodes_m": corners}
    part = Rigid(name="plate", turns=turns, places_m=places, **made)
    content = Moving(time_s=time, parts=[part], caption="A plate.").content()
    shown = places[:, None] + corners @ turns.swapaxes(1, 2)
    assert (shown >= np.array(content["low"])).all() and (shown <= np.array(content["high"])).all()


def test_a_long_motion_is_thinned_to_its_size():
    faces, nodes = bar(4000)
    body = Deforming(name="bar", color="#0b6e75", triangles=faces, nodes_m=nodes)
    long = Moving(time_s=np.arange(4000) / 1000, parts=[body], caption="")
    assert 0.5 * MAX_BYTES < len(long.html) < 1.05 * MAX_BYTES
    times = np.diff(long.content()["time"])
    np.testing.assert_allclose(times, times[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time_s": np.arange(4.0)}, "'bar' must have 4 frames, as time_s has, got 5"),
        ({"parts": []}, "needs a part and a frame"),
        (
            {"parts": [Line(name="p", color="#000000", points_m=np.full((2, 3), np.nan))]},
            "positions of 'p' must be finite",
        ),
    ],
)
def test_mistakes_are_named(change, words):
    with pytest.raises(ValueError, match=words):
        replace(view(), **change)


def test_too_many_triangles_are_refused():
    body = view().parts[0]
    many = replace(body, triangles=np.tile(body.triangles, (400, 1)))
    with pytest.raises(ValueError, match="at most 30,000 triangles"):
        replace(view(), parts=[many])


def swings() -> report.Chart:
    """Two runs of one cause each, as the diagnosis draws them."""
    figure = charts.grid(1, titles=["swing"])
    t = np.linspace(0.0, 2.0, 200)
    for name, lag in (("measured", 0.0), ("without cause", 0.4)):
        figure.add_trace(charts.line(t, np.sin(6 * t + lag), name, "#0b6e75"), row=1, col=1)
    return report.Chart(figure=figure, caption="")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_what_faces_away_is_not_drawn(tmp_path):
    cube = mesh.hex_box((1, 1, 1), (0.1, 0.1, 0.1))
    faces = mesh.surface_triangles(cube).faces.numpy()
    drawn = []
    with Browser(tmp_path / "profile") as browser:
        for closed in (False, True):
            body = Deforming(
                name="cube", color="#0b6e75", triangles=faces, nodes_m=cube.nodes.numpy()[None],
                closed=closed,
            )  # fmt: skip
            content = [Moving(time_s=np.zeros(1), parts=[body], caption="")]
            section = report.Section(title="See", content=content)
            page = report.Report(title="p", subtitle="", verdict=[], sections=[section])
            browser.open(report.write(page, tmp_path / f"{closed}.html"))
            browser.until("document.querySelector('.moving').dataset.drawn")
            drawn.append(int(browser.js("document.querySelector('.moving').dataset.drawn")))
        assert browser.complaints == []
    assert drawn == [12, 6]  # of a cube three sides are seen, from above the top one among them


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
@pytest.mark.parametrize("sides", [(0.02, 0.02, 0.6), (0.6, 0.02, 0.02), (0.3, 0.3, 0.3)])
def test_all_that_moves_is_in_the_view_and_fills_it(tmp_path, sides):
    solid = mesh.hex_box((1, 1, 1), sides)
    faces = mesh.surface_triangles(solid).faces.numpy()
    nodes = solid.nodes.numpy()[None]
    body = Deforming(name="pole", color="#d00000", triangles=faces, nodes_m=nodes, closed=True)
    content = [Moving(time_s=np.zeros(1), parts=[body], caption="")]
    section = report.Section(title="See", content=content)
    page = report.Report(title="p", subtitle="", verdict=[], sections=[section])
    red = """(() => {
      const canvas = document.querySelector(".moving canvas"), w = canvas.width, h = canvas.height;
      const dots = canvas.getContext("2d").getImageData(0, 0, w, h).data;
      let [left, right, top, bottom] = [1, 0, 1, 0];
      for (let y = 0; y < h; y++) for (let x = 0; x < w; x++) {
        const k = 4 * (y * w + x);
        if (dots[k + 3] < 200 || dots[k] < dots[k + 1] + 40) continue;
        left = Math.min(left, x / w); right = Math.max(right, x / w);
        top = Math.min(top, y / h); bottom = Math.max(bottom, y / h);
      }
      return [left, right, top, bottom];
    })()"""
    with Browser(tmp_path / "profile") as browser:
        browser.open(report.write(page, tmp_path / "pole.html"))
        browser.until("document.querySelector('.moving').dataset.drawn")
        left, right, top, bottom = browser.js(red)
        assert browser.complaints == []
    assert min(left, 1.0 - right, top, 1.0 - bottom) > 0.02
    assert max(right - left, bottom - top) > 0.7


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_browser_turns_plays_toggles_and_zooms(tmp_path):
    page = report.Report(
        title="A page",
        subtitle="to play with",
        verdict=["It moves."],
        sections=[report.Section(title="See", content=[view(), swings()])],
    )
    path = report.write(page, tmp_path / "page.html")
    assert path.stat().st_size < 3_000_000
    with Browser(tmp_path / "profile") as browser:
        browser.open(path)
        browser.until("document.querySelectorAll('.legendtoggle').length === 2")
        box = "document.querySelector('.moving')"
        pixels = f"{box}.querySelector('canvas').toDataURL()"
        faces = len(view().parts[0].triangles)
        assert browser.js(f"{box}.dataset.drawn") == str(2 * faces)

        first = browser.js(pixels)
        x, y = browser.middle(".moving canvas")
        browser.drag((x, y), (x + 120, y + 30))
        turned = browser.js(pixels)
        assert turned != first
        browser.click(".moving-bar .moving-part:nth-of-type(2)")  # the first part's button
        assert browser.js(f"{box}.dataset.drawn") == str(faces)
        pressed = f"{box}.querySelector('.moving-part').getAttribute('aria-pressed')"
        assert browser.js(pressed) == "false"
        browser.click(".moving-bar button")
        browser.until(f"Number({box}.dataset.frame) > 1")
        browser.click(".moving-bar button")
        assert browser.js(f"{box}.querySelector('button').textContent") == "Play"
        assert browser.js(pixels) not in (first, turned)

        plot = "document.querySelector('.plotly-graph-div')"
        wide = browser.js(f"{plot}._fullLayout.xaxis.range")
        x, y = browser.middle(".plotly-graph-div .nsewdrag")
        browser.drag((x - 100, y - 20), (x + 100, y + 20))
        browser.until(
            f"{plot}._fullLayout.xaxis.range[1] - {plot}._fullLayout.xaxis.range[0] < 1.0"
        )
        assert browser.js(f"{plot}._fullLayout.xaxis.range")[0] > wide[0]
        browser.click(".legendtoggle")
        browser.until(f"{plot}._fullData[0].visible === 'legendonly'")
        assert browser.complaints == []
        assert browser.picture(tmp_path / "page.png").stat().st_size > 10_000
