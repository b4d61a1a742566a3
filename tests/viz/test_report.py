"""The HTML report and its figures: one file, nothing from outside, everything escaped."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from diffsim.viz import figures
from diffsim.viz import report as rp
from examples.demo import panels
from tests.optional import needs

needs("matplotlib", reason="reports need pip install -e '.[viz]'")
needs("jinja2", reason="reports need pip install -e '.[viz]'")


def example(**changes) -> rp.Report:
    t = np.linspace(0, 1, 50)
    curve = panels.Curve(x=t, y=np.sin(9 * t) * 1e-3, label="measured <b>", points=True)
    picture = rp.Picture(
        uri=figures.data_uri(panels.trajectories([("a", [curve])], ylabel="z [mm]")),
        caption="Tip height & time",
    )
    table = rp.Table(columns=["trial", "f [Hz]"], rows=[["a", "7.75"], ["b", "7.73"]], emphasis=[1])
    settings = {
        "title": "Beam <script>alert(1)</script>",
        "subtitle": "Four recordings",
        "verdict": ["The simulation is off by 0.2 mm."],
        "numbers": [rp.Number(label="f", value="7.75", unit="Hz", tone="good")],
        "sections": [rp.Section(title="Motion", text=["See."], content=[picture, table])],
        "held_fixed": [("density", "1070 kg/m3")],
    }
    return rp.Report(**{**settings, **changes})


def test_a_phone_is_shown_the_picture_that_was_drawn_for_it():
    wide = rp.Picture(uri="data:image/png;base64,QQ==", caption="Tip")
    narrow = rp.Picture(uri=wide.uri, caption="Tip", narrow="data:image/png;base64,Qg==")
    html = rp.render(example(opening=[narrow]))
    source = '<source media="(max-width: 40rem)" srcset="data:image/png;base64,Qg==">'
    assert html.count("<source") == html.count(source) == 1
    assert "<source" not in rp.render(example(opening=[wide]))


class Tags(HTMLParser):
    VOID = ("meta", "img", "br", "link")

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict]] = []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_page_is_well_formed_and_self_contained():
    page = rp.render(example())
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert "script" not in {tag for tag, _ in tags.seen}
    sources = [a[k] for _, a in tags.seen for k in ("src", "href") if k in a]
    assert sources and all(s.startswith("data:image/") for s in sources)
    assert "http" not in re.sub(r'src="data:[^"]*"', "", page)


def test_verdict_comes_before_figures_and_text_is_escaped():
    page = rp.render(example())
    assert page.index("off by 0.2 mm") < page.index("<figure>") < page.index("<table>")
    assert "&lt;script&gt;" in page
    assert "Tip height &amp; time" in page
    emphasis = re.search(r'<tr class="emphasis"><td data-label="([^"]*)">b</td>', page)
    assert emphasis is not None and emphasis[1]  # a phone shows it beside the cell
    for what in ("diffsim", "torch", "numpy", "1070 kg/m3"):
        assert what in page


def test_a_column_is_aligned_as_a_whole():
    rows = [["a", "7.75", "< 0.001", "mm", "2.1 (1 to 3)"], ["b", "–", "0.4", "–", "x: 3"]]
    table = rp.Table(columns=["run", "f", "p", "unit", "size"], rows=rows)
    assert table.numeric == {1, 2}
    assert rp.Table(columns=["run", "f"], rows=[]).numeric == frozenset()


def test_banner_is_on_top_and_at_the_end():
    page = rp.render(example(banner="VIRTUAL DATA, not measured"))
    assert page.count("VIRTUAL DATA") == 2
    assert page.index("VIRTUAL DATA") < page.index("<h1>")
    assert "role=" not in rp.render(example())


def test_written_atomically(tmp_path):
    path = rp.write(example(), tmp_path / "out" / "report.html")
    assert path.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


def test_mistakes_have_messages():
    with pytest.raises(ValueError, match=r"table row 0 has 1 cells, but there are 2 columns"):
        rp.Table(columns=["a", "b"], rows=[["1"]])
    with pytest.raises(ValueError, match=r"tone must be one of"):
        rp.Number(label="f", value="1", tone="great")


def test_every_figure_draws_and_leaves_matplotlib_alone():
    import matplotlib

    before = dict(matplotlib.rcParams)
    t = np.linspace(0.01, 1, 60)
    a = panels.Curve(x=t, y=1e-3 * np.exp(-t), label="a")
    b = panels.Curve(x=t, y=2e-3 * np.exp(-t), label="b", role="fitted", dashed=True)
    drawn = [
        panels.trajectories([("one", [a, b]), ("two", [b])], ylabel="z [mm]"),
        panels.spectra([("one", [a, b])], max_Hz=30.0, floor_m=1e-6),
        panels.decay_envelopes([("one", [a]), ("two", [b])]),
        panels.residuals([("one", [a], b), ("two", [b], None)], ylabel="error [mm]"),
        panels.bars(["g", "l"], [("m", [1.0, 2.0], "measured"), ("s", [1.5, np.nan], "fitted")],
                     ylabel="f [Hz]", reference=[1.2, 1.9], reference_label="floor"),
    ]  # fmt: skip
    for figure in drawn:
        kind, _, payload = figures.data_uri(figure).partition(",")
        assert kind == "data:image/svg+xml;base64"
        assert b"</svg>" in base64.b64decode(payload)
    png = base64.b64decode(figures.data_uri(drawn[0], png=True).partition(",")[2])
    assert png.startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before
