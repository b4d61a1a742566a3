"""The report of a sim-to-real loop: Table 5.2 with uncertainties, and Figs. 5-6 to 5-9 of ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim import mesh
from diffsim.core.files import write_bytes_atomic, write_json_atomic
from diffsim.viz import diagnosis_charts
from diffsim.viz import report as page
from diffsim.viz.figures import COLORS, data_uri
from diffsim.viz.moving import Deforming, Moving
from labs.loop import figures as loop_figures
from labs.loop.command import RATE_HZ
from labs.loop.model import PLACES_M, Starfish
from labs.loop.recordings import COMMAND

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from labs.loop.records import Iteration, LoopResult

Array = NDArray[np.float64]
SHORT = {"youngs_modulus": "E [Pa]", "axial_stiffness": "w = EA [N]"}


def table_5_2(result: LoopResult) -> list[dict[str, Any]]:
    """Rows of Table 5.2 for JSON, SI units."""
    rows = []
    for it in result.iterations:
        fit = it.identified
        rows.append(
            {
                "iteration": loop_figures.name_of(it),
                "L_theta_m2": it.loss_theta,
                "L_theta_before_m2": None if fit is None else fit.loss_before,
                "rms_after_m": None if fit is None else fit.rms_after,
                "L_a_m": it.loss_action,
                "L_a_before_m": it.loss_action_before,
                "v_s_m_s": it.speed_simulated,
                "v_r_m_s": it.speed_measured,
                "values": it.values,
                "sd": None if fit is None else fit.sd,
                "correlation_E_w": None if fit is None else fit.correlation[0][1],
                "at_bound": [] if fit is None else list(fit.at_bound),
                "undetermined": [] if fit is None else list(fit.undetermined),
            }
        )
    return rows


def write_loop(
    result: LoopResult,
    model: Starfish,
    folder: str | Path,
    *,
    fit_s: float,
    real: Mapping[str, Any] | None = None,
) -> Path:
    """``report.html``, ``table_5_2.json`` and the figures as PNG and SVG.

    Args:
        result: Result of the loop between simulation and recording.
        model: Model of the starfish that the loop was made with.
        folder: Folder that the files are written to.
        fit_s: Length of the recordings that parameters were fitted to [s].
        real: Result of :func:`labs.loop.on_real_recording`; None: left out.

    Returns:
        Path of the page.
    """
    folder = Path(folder)
    figures = {
        "speeds": loop_figures.progress(result.iterations),
        "markers": loop_figures.markers(_fits(result, model, fit_s)),
        "travel": loop_figures.travel(result.iterations),
        "commands": loop_figures.commands(result.iterations),
        "strip": _strip(result, model),
    }
    uris = {name: _save_figure(figure, folder / name) for name, figure in figures.items()}
    content: dict[str, Any] = {
        "hardware": result.hardware,
        "virtual": result.virtual,
        "converged": result.converged,
        "best_so_far_m_s": result.best_so_far,
        "iterations": table_5_2(result),
    }
    if real is not None:
        content["real_recording"] = real
    write_json_atomic(folder / "table_5_2.json", content)
    view = moving_starfish(result, model)
    return page.write(_page(result, uris, view, real), folder / "report.html")


def _page(
    result: LoopResult, uris: Mapping[str, str], view: Moving, real: Mapping[str, Any] | None
) -> page.Report:
    first, best, last = result.iterations[0], result.best, result.iterations[-1]
    gap = abs(last.speed_simulated - last.speed_measured)
    stop = "converged" if result.converged else "stopped at the greatest number of iterations"
    pictures = [
        page.Picture(uri=uris[name], caption=caption)
        for name, caption in _CAPTIONS.items()
        if name in uris
    ]
    sections = [
        page.Section(title="Progress", content=[pictures[0], _table(result.iterations)]),
        page.Section(title="The robot in motion", content=[view]),
        page.Section(title="Parameters", text=[_TRADE], content=_parameters(result.iterations)),
        page.Section(title="Figures", content=pictures[1:]),
        *_correlations(result),
    ]
    if real is not None:
        sections.append(_real_section(real))
    return page.Report(
        title="Sim-to-real loop of a starfish",
        subtitle=f"Thesis Alg. 7 on: {result.hardware}",
        banner="Virtual hardware: every recording was computed." if result.virtual else None,
        verdict=[
            f"Measured speed went from {1e2 * first.speed_measured:.2f} cm/s (bl-ctrl) to "
            f"{1e2 * best.speed_measured:.2f} cm/s (iteration {best.idx}); the loop {stop}.",
            f"Prediction and measurement of the last iteration differ by {1e2 * gap:.2f} cm/s.",
        ],
        numbers=[
            page.Number(label="best speed", value=f"{1e2 * best.speed_measured:.2f}", unit="cm/s"),
            page.Number(label="last gap |v_s - v_r|", value=f"{1e2 * gap:.2f}", unit="cm/s"),
        ],
        sections=sections,
    )


def _correlations(result: LoopResult) -> list[page.Section]:
    """Of the last identification; none where nothing was identified."""
    last = result.iterations[-1].identified
    if last is None:
        return []
    chart = diagnosis_charts.confounding_matrix(
        last.names, np.array(last.correlation), bar="posterior correlation"
    )
    content = [page.Chart(figure=chart, caption="Beyond ±0.95 boxed.")]
    return [page.Section(title="Correlations of the last identification", content=content)]


_CAPTIONS = {
    "speeds": "Forward speed between the second period and the last, mean of four markers.",
    "markers": "After thesis Fig. 5-6: markers before and after identification, from rest (open) "
    "to the end of the fitted part (filled), seen with the identified clock.",
    "travel": "After Fig. 5-7: mean of the four markers; simulations are predictions, made before "
    "the experiment.",
    "commands": "After Fig. 5-8: optimized commands; grey: bl-ctrl.",
    "strip": "After Fig. 5-9: the simulated robot (orange), the measured markers (dots).",
}
_TRADE = (
    "Value ± posterior standard deviation with the prior (misfit taken as colored). A strong "
    "correlation of E and w says that the data see a combination of both; a tilde marks what the "
    "data tell little about, an asterisk what lies on its bound, where ± says nothing."
)


def _table(iterations: Sequence[Iteration]) -> page.Table:
    rows = [
        [
            loop_figures.name_of(i),
            f"{i.loss_theta:.2e}",
            f"{i.loss_action:.2e}",
            f"{1e2 * i.speed_simulated:.2f}",
            f"{1e2 * i.speed_measured:.2f}",
            f"{i.values['youngs_modulus']:.2e}",
            f"{i.values['axial_stiffness']:.2e}",
        ]
        for i in iterations
    ]
    return page.Table(
        columns=["iter.", "L_theta [m²]", "L_a [m]", "v_s [cm/s]", "v_r [cm/s]", *SHORT.values()],
        rows=rows,
        caption="As thesis Table 5.2. Row k: theta fitted to the recording of row k - 1, the "
        "command optimized for it, its predicted (v_s) and then measured (v_r) speed.",
    )


def _parameters(iterations: Sequence[Iteration]) -> list[page.Table]:
    names = list(iterations[0].values)
    rows = []
    for it in iterations:
        cells = [loop_figures.name_of(it)]
        cells += [_cell(it, name) for name in names]
        fit = it.identified
        cells.append("" if fit is None else f"{fit.correlation[0][1]:+.2f}")
        rows.append(cells)
    heads = [SHORT.get(n, n.replace("drag_", "C_d ").replace("thrust_", "C_t ")) for n in names]
    return [page.Table(columns=["iter.", *heads, "corr(E, w)"], rows=rows)]


def _cell(it: Iteration, name: str) -> str:
    value, fit = it.values[name], it.identified
    if fit is None:
        return f"{value:.3g}"
    mark = "*" if name in fit.at_bound else "~" if name in fit.undetermined else ""
    return f"{value:.3g} ± {fit.sd[name]:.1g}{mark}"


def _real_section(real: Mapping[str, Any]) -> page.Section:
    rows = [
        [r["run"], r["use"]]
        + [f"{1e3 * r[k]:.2f}" for k in ("rms_still_m", "rms_before_m", "rms_after_m")]
        for r in real["runs"]
    ]
    table = page.Table(
        columns=["window", "use", "rms, no motion [mm]", "first guesses", "identified"], rows=rows
    )
    values = page.Table(
        columns=["parameter", "value ± sd", "prior only"],
        rows=[
            [n, f"{real['values'][n]:.3g} ± {real['sd'][n]:.1g}", str(n in real["undetermined"])]
            for n in real["values"]
        ],
    )
    return page.Section(
        title="The same identification on the measured robot",
        text=["Recordings of the real starfish; held-out windows set their own clock only."],
        content=[table, values],
    )


def _fits(result: LoopResult, model: Starfish, fit_s: float) -> list[tuple[str, Array, Array]]:
    """Measured and simulated displacements before and after every identification."""
    pairs = []
    for before, after in zip(result.iterations, result.iterations[1:], strict=False):
        n = round(fit_s * RATE_HZ)
        run = before.run
        measured = run.measured[:n] - np.nanmean(run.measured[:6], axis=0)
        clock = 0.0
        if after.identified is not None:
            clock = after.identified.values.get(f"clock_offset@{run.name}", 0.0)
        for label, values in (("before", before.values), ("after", after.values)):
            moved = _simulate_markers(model, values, run.command[COMMAND][:n], clock)
            pairs.append((f"identification {after.idx}, {label}", measured, moved))
    return pairs


def _simulate_markers(
    model: Starfish, values: Mapping[str, float], executed: Array, clock: float
) -> Array:
    """Displacements (n, 8) of the markers under an executed contraction [m]."""
    tensors = {n: torch.tensor(v, dtype=torch.float64) for n, v in values.items()}
    times = torch.arange(len(executed), dtype=torch.float64) / RATE_HZ
    offset = torch.tensor(clock, dtype=torch.float64)
    with torch.no_grad():
        scene = model.scene(tensors, torch.from_numpy(executed.copy()), times, offset)
        moved = scene.simulate().numpy()[:, :-1]
    return np.asarray(moved - moved[:6].mean(0))


def _strip(result: LoopResult, model: Starfish, count: int = 5) -> Figure:
    shots = []
    for it in (result.iterations[0], result.best):
        num_samples = min(len(it.run.time_s), round(3.0 * it.command.period_s * RATE_HZ))
        x = _vertices(model, it, num_samples)
        seen = it.run.measured[:num_samples] - np.nanmean(it.run.measured[:6], axis=0)
        places = seen.reshape(-1, 4, 2) + np.stack([np.zeros(4), np.array(PLACES_M)], 1)
        picked = np.linspace(0, num_samples - 1, count).round().astype(int)
        row = [(float(it.run.time_s[k]), x[k], places[k]) for k in picked]
        shots.append((loop_figures.name_of(it), row))
    return loop_figures.strip(shots, mesh.surface_triangles(model.quarter.body.mesh).faces.numpy())


def moving_starfish(result: LoopResult, model: Starfish, aside_m: float = 0.2) -> Moving:
    """First and best command side by side, simulated; forwards is up.

    Args:
        result: Result of the loop.
        model: Model of the starfish that the loop was made with.
        aside_m: Distance between the two [m].
    """
    runs = {loop_figures.name_of(it): it for it in (result.iterations[0], result.best)}
    counts = [
        min(len(it.run.time_s), round(3.0 * it.command.period_s * RATE_HZ)) for it in runs.values()
    ]
    faces = mesh.surface_triangles(model.quarter.body.mesh).faces.numpy()
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    parts = []
    colors = (COLORS["published"], COLORS["fitted"])
    for column, ((name, it), color) in enumerate(zip(runs.items(), colors, strict=False)):
        quarter = _vertices(model, it, min(counts))[:, used]
        # the quarter is y, z > 0; mirrors at both planes make the whole
        whole = [quarter * [1.0, y, z] for y in (1.0, -1.0) for z in (1.0, -1.0)]
        nodes = np.concatenate(whole, axis=1)
        nodes = np.stack([nodes[..., 2] + column * aside_m, nodes[..., 1], -nodes[..., 0]], -1)
        shifted = [faces + k * len(used) for k in range(4)]
        parts.append(
            Deforming(name=name, color=color, triangles=np.concatenate(shifted), nodes_m=nodes)
        )
    return Moving(
        time_s=np.arange(min(counts)) / RATE_HZ,
        parts=parts,
        caption="Simulated with each iteration's parameters, forwards is up. Drag to turn, wheel "
        "to zoom; a button hides what it names.",
    )


def _vertices(model: Starfish, it: Iteration, num_samples: int) -> Array:
    """(num_samples, num_nodes, 3) of the quarter, from where it is at the start [m]."""
    values = {n: torch.tensor(v, dtype=torch.float64) for n, v in it.values.items()}
    times = torch.arange(num_samples, dtype=torch.float64) / RATE_HZ
    wish = torch.from_numpy(it.command.during(num_samples / RATE_HZ))
    scene = model.scene(values, wish, times).changed(observe=lambda x: x.flatten(-2))
    with torch.no_grad():
        x = scene.simulate().numpy().reshape(num_samples, -1, 3)
    return np.asarray(x - [x[0, model.quarter.nodes, 0].mean(), 0.0, 0.0])


def _save_figure(figure: Figure, stem: Path) -> str:
    """PNG and SVG beside the page; the PNG for it."""
    import base64

    svg = data_uri(figure).partition(",")[2]
    png = data_uri(figure, png=True)
    write_bytes_atomic(stem.with_suffix(".svg"), base64.b64decode(svg))
    write_bytes_atomic(stem.with_suffix(".png"), base64.b64decode(png.partition(",")[2]))
    return png
