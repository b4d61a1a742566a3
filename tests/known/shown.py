"""Populations of what is shown: pages of every kind, figures, the index of runs, films."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.known.pages import parts_of_page


def pages(folder: Path) -> dict[str, Any]:
    """A page of every kind, with laws and bodies that move."""
    from diffsim.viz import diagnosis_report, diagnosis_series
    from tests.viz import test_diagnosis_laws as laws
    from tests.viz import test_diagnosis_report as example
    from tests.viz import test_narrow_pages as every

    number = replace(laws.COGGING, entry={"kind": "number", "target": "drag"}, formula="size*u")
    heat = replace(laws.COGGING, variables=("current",), memory="heat", formula="size*u")
    asked = {"force": laws.COGGING, "number": number, "heat": heat}
    curves = tuple(map(rough, laws.CURVES))
    reports = {
        name: laws.described(replace(laws.ANSWER, laws=(law,), curves=curves))
        for name, law in asked.items()
    }
    reports["moving"] = example.moving_example()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosis_series, "held_out_point", lambda fit, run: (fit.x, None))
        paths = list(every.pages(folder))
        for name, report in reports.items():
            paths.append(diagnosis_report.write_diagnosis(report, folder / f"{name}.html"))
    return parts_of(paths)


def flights(folder: Path) -> dict[str, Any]:
    """The page of a flight."""
    from diffsim.viz.flight_page import flight_page
    from diffsim.viz.report import write

    design, log = flown(seconds=1.0)
    return parts_of([write(flight_page(log, design), folder / "flight.html")])


def parts_of(paths: Iterable[Path]) -> dict[str, Any]:
    """Numbers of all parts of pages, by the names of their files."""
    return {
        f"{path.stem} {part}": value
        for path in paths
        for part, value in parts_of_page(path.read_text("utf-8"))
    }


def rough(curve: Any) -> Any:
    """A curve of a law that is off its formula, and known less and less."""
    off = 1e-3 * np.cos(9.0 * np.array(curve.u))
    sd = np.geomspace(1e-4, 1e-2, len(curve.u))
    return replace(curve, value=tuple(np.add(curve.value, off)), sd=tuple(sd))


def flown(seconds: float) -> Any:
    """A design and the log of its flight."""
    from diffsim.copter import load_design
    from diffsim.copter.simulator import load_mission
    from diffsim.copter.simulator.flight_simulator import FlightSimulator

    design = load_design("pentacopter")
    simulator = FlightSimulator(design)
    simulator.run(load_mission("there_and_back"), seconds=seconds)
    return design, simulator.log


def drawn_in(figure: Any) -> list[Any]:
    """Everything that a figure of matplotlib draws."""
    out: list[Any] = []
    for ax in figure.axes:
        out += [ax.get_xlim(), ax.get_ylim(), ax.get_title(), ax.get_xlabel(), ax.get_ylabel()]
        for image in ax.images:
            out += [np.ma.filled(image.get_array(), np.nan), image.get_extent(), image.get_clim()]
        out += [line.get_xydata() for line in ax.lines]
        for many in ax.collections:
            colors = many.get_array()
            out.append([path.vertices for path in many.get_paths()])
            out.append([many.get_offsets(), [] if colors is None else np.ma.filled(colors, 0.0)])
        out += [patch.get_path().vertices for patch in ax.patches]
        out += [(text.get_text(), text.get_position()) for text in ax.texts]
    return out


def figures(folder: Path) -> dict[str, Any]:
    """Figures of flows, rotors and flights."""
    from diffsim.copter.vehicle.fit_rotor import fit_rotor
    from diffsim.viz import flight_figures, flow, rotors
    from tests.copter.vehicle.test_rotor import synthetic
    from tests.viz.test_flow import channel

    flat, tube = channel(2, size=2e-3), channel(3)
    _, log = flown(seconds=0.5)
    made = {
        "speed": flow.speed_map(flat, lines=5),
        "second case": flow.speed_map(flat, case=1, lines=0),
        "compared": flow.compare([("a", flat), ("b", channel(2))], case=1),
        "slices": flow.slices(tube),
        "view": flow.view([("a", tube), ("b", tube)], lines=4),
        "plane": flow.compare([("tube", tube)], plane=("x", 1.0)),
        "motors": flight_figures.motor_outputs([("a", log), ("b", log)]),
        "rotor": rotors.rotor_fit(fit_rotor(synthetic(0.02))),
    }
    return {name: drawn_in(figure) for name, figure in made.items()}


def runs(folder: Path) -> dict[str, Any]:
    """What the index says of runs of every kind, finished or not."""
    from diffsim.viz.run_folders import run_folders
    from diffsim.viz.run_index import render_index

    written = {
        "cart/report.json": '{"headline": "Dry friction is missing."}',
        "cart/report.html": "<h1>cart</h1>",
        "cart/runs.rrd": "rrd",
        "half/report.json": '{"headline": "not wr',
        "later/judge.json": '{"headline": "From 2 to 1 mm."}',
        "shark/results.jsonl": '{"steps": 400, "reward": 0.31}\n{"steps": 800, "rew',
        "fish/results.jsonl": "\n".join(f'{{"steps": {k}, "reward": {k}.5}}' for k in range(40)),
        "funnel/progress.jsonl": "{}\n{}\n{}\n",
        "fly/flight.csv": "time,x\n0.5,1\n1.25,2\n",
        "bare/flight.csv": "time,x\n",
        "opt/result.json": '{"loss": 0.125}',
        "opt/progress.jsonl": "{}\n",
        "plan/plan.yaml": "mass: 2",
        "docs/index.html": "a site",
        "docs/404.html": "a site",
    }
    for name, text in written.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, "utf-8")
    found = run_folders(folder)
    links = re.findall(r'href="[^"]*"', render_index(folder, found, "http://v:1", "http://b:2"))
    return {
        "links": [sorted(links), len(found)],
        **{run.path: [run.kind, run.said, run.progress, run.files] for run in found},
    }


def cameras(folder: Path) -> dict[str, Any]:
    """Cameras that are found from clicks, which are off by a pixel."""
    from diffsim.data.calibration import calibrate
    from tests.data import test_calibration as camera

    out = {}
    for focal in (700.0, 5000.0):
        pixels = camera.clicked(focal, camera.LEVEL, np.array([1.5, 1.0, -4.0]))
        pixels += np.random.default_rng(0).normal(size=pixels.shape)
        out[f"focal {focal}"] = calibrate(camera.GRID, pixels, camera.SIZE)
    return out


SHOWN: Mapping[str, Callable[[Path], Mapping[str, Any]]] = {
    "pages": pages,
    "figures": figures,
    "flights": flights,
    "runs": runs,
    "cameras": cameras,
}
