"""Pages in a browser as wide as a laptop's and as a phone's: nothing lies beyond the edge."""

import pytest

from diffsim.diagnose.faults.verdict import FaultReport, FaultVerdict, SetRow, Size
from diffsim.diagnose.judge.records import Interval
from diffsim.sim_to_real.worth import Worth
from diffsim.viz import diagnosis_series
from tests.browser import CHROMIUM, Browser
from tests.optional import needs

needs("plotly")

pytestmark = [
    pytest.mark.serial,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here"),
]
BEYOND = """(() => {
  const shown = [...document.querySelectorAll('main *')].filter(
    (e) => !e.closest('svg') && !e.closest('details:not([open])'));
  const boxes = shown.map((e) => [e, e.getBoundingClientRect()]);
  const out = boxes.filter(([, b]) => b.width && (b.right > innerWidth + 1 || b.left < -1));
  const tables = [...document.querySelectorAll('.scroll')]
    .filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => [e]);
  return [...out, ...tables].map(([e]) => `${e.tagName} ${e.textContent.slice(0, 40)}`);
})()"""
DRAWN = "document.querySelectorAll('script[type=\"text/x-chart\"]').length === 0"


def faulty() -> FaultReport:
    size = Size(
        "thrust_loss", "-", Interval(0.2, 0.15, 0.25), "rotor 2 has lost 20 % of its thrust"
    )
    sets = (SetRow(("thrust_loss",), 0.99, 0.99, False), SetRow((), 0.01, 0.01, False))
    named = FaultVerdict(
        "E7_of_the_second_campaign", ("flight_1", "flight_2"), "", None, "certain",
        ("thrust_loss",), 1e-6, 40.0, (size,), (), sets, {}, f"{size.words}.",
        facts={"vehicle": "E7", "battery": "half full"}, files=("flight_1.csv", "flight_2.csv"),
    )  # fmt: skip
    seen = ("0.34 g more mass on the arm", "2 % less thrust of a rotor", "bent shaft 0.3")
    sound = FaultVerdict(
        "E9", ("flight_3",), "", None, "nothing visible", (), 0.98, 0.0, (), (), (), {},
        "Nothing visible beyond the scatter between groups.", visible=seen,
    )  # fmt: skip
    return FaultReport("drones", (), (named, sound))


def pages(folder):
    """A page of every kind, with all that it may hold."""
    from diffsim.viz.diagnosis_report import write_diagnosis
    from diffsim.viz.faults_report import faults_page
    from diffsim.viz.judged_report import judgment_page
    from diffsim.viz.report import write
    from diffsim.viz.worth_page import worth_page
    from tests.viz import test_diagnosis_report, test_judged_report

    yield write_diagnosis(test_diagnosis_report.example(), folder / "report.html")
    judged = test_judged_report
    yield write(judgment_page(judged.found(), judged.STUDY, judged.SAVED), folder / "judge.html")
    yield write(faults_page(faulty()), folder / "faults.html")
    rows = [
        Worth("dry_friction_at_the_bearing", 4.0, 3.0, 1.5, 4.4, noise=0.02),
        Worth("lag", 4.0, 4.0, 3.99, 4.0, noise=0.02),
    ]
    yield write(worth_page(rows, "cart", [("task", "task.yaml")]), folder / "worth.html")


def test_nothing_is_cut_on_a_laptop_or_a_phone(tmp_path, monkeypatch):
    monkeypatch.setattr(diagnosis_series, "held_out_point", lambda fit, run: (fit.x, None))
    with Browser(tmp_path / "profile") as browser:
        for path in pages(tmp_path):
            for width in (1280, 390):
                size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
                browser.call("Emulation.setDeviceMetricsOverride", **size)
                browser.open(path)
                browser.until(DRAWN)
                assert browser.js(BEYOND) == [], (path.name, width)
        assert browser.complaints == []


def test_what_does_not_pay_and_what_to_do_are_said():
    from diffsim.viz.faults_report import faults_page
    from diffsim.viz.worth_page import worth_page

    assert Worth("lag", 4.0, 4.0, 3.99, 4.0, noise=0.02).words.endswith("mending it buys nothing")
    page = worth_page([Worth("own_lag", 4.0, 4.0, 3.9, 4.0, noise=0.02)], "cart", [])
    assert [(n.label, n.value) for n in page.numbers] == [("mending own lag buys", "0.1")]
    assert page.verdict == [
        "Mending own lag buys most: its best miss goes from 4 to 3.9; a command that does not know "
        "of it has 4."
    ]
    shown = worth_page([Worth("lag", 4.0, 2.0, 1.0, 9.0, unit="rad", one=0.001)], "cart", [])
    assert (shown.numbers[0].value, shown.numbers[0].unit) == ("3", "mrad")
    assert "from 4 mrad to 1 mrad; a command that does not know of it has 9 mrad" in str(shown)
    bars = shown.sections[0].content[1].figure
    assert bars.layout.xaxis.title.text == "rms of the misses [mrad]"
    assert "20" in bars.layout.xaxis.ticktext
    assert [bar.x[0] for bar in bars.data] == [4.0, 2.0, 1.0, 9.0]
    harm = Worth("lag", 4.0, 4.1, 4.2, 4.2, noise=0.02)  # it said: buys -0.2
    page = worth_page([harm], "cart", [])
    assert page.verdict[0].startswith("Mending no cause buys this task anything")
    assert page.numbers[0].value == "nothing" and harm.words.endswith("buys nothing")
    groups = faults_page(faulty()).sections[0].content[0]
    told = list(groups.columns).index("what to do next")
    assert [row[told].partition(" ")[0] for row in groups.rows] == ["Mend", "Nothing"]
