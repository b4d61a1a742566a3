"""The demo: a silicone beam, measured against simulated, on one page (``diffsim demo``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tqdm import tqdm

from diffsim import __version__
from diffsim._files import write_json_atomic
from diffsim.data.beam import BeamStudy, load_beam_study
from diffsim.data.recording import find_dataset
from diffsim.data.virtual_lab import write_beam_study
from diffsim.demo import measured
from diffsim.demo.stages import Stages, file_digest

VIRTUAL_BANNER = (
    "VIRTUAL DATA. No measured recordings were found, so these were computed by diffsim's "
    "virtual laboratory. Nothing on this page says anything about a real beam. "
    "Set DIFFSIM_DATA to the folder that holds silicone_beam/ to use the measured ones."
)


def main(
    data: str | Path | None = None,
    out: str | Path = "runs/demo",
    quick: bool = False,
    resume: bool = False,
    threads: int | None = None,
) -> dict[str, Any]:
    """Compare simulation and measurement of the clamped silicone beam; write one page.

    Args:
        data: Folder that holds ``silicone_beam``; by default DIFFSIM_DATA, then
            ``../shared/data``; if there is none, a virtual laboratory makes the recordings.
        out: ``report.html``, ``results.json`` and ``stages/`` are written here.
        quick: Coarser meshes and fewer steps, for a first look.
        resume: Take finished stages of an earlier, interrupted run as they are.
        threads: Of the simulator; by default all processors.

    Returns:
        All numbers of the report.
    """
    out = Path(out)
    study = load_study(data, out)
    files = [study.folder / "metadata.yaml", *(t.recording.source for t in study.trials)]
    settings = {
        "version": __version__,
        "quick": quick,
        "data": file_digest([path for path in files if path is not None]),
    }
    stages = Stages(out, settings, resume=resume)
    progress = tqdm(total=2, unit="stage", desc="demo")
    try:
        results = {"is_virtual": study.is_virtual, "data": str(study.folder)}
        progress.set_postfix_str("recordings")
        results["measured"] = stages.run("measured", lambda: measured.describe(study))
        progress.update()
        progress.set_postfix_str("page")
        write_json_atomic(out / "results.json", results)
        _write_page(study, results, out)
        progress.update()
    except KeyboardInterrupt:
        progress.write(f"stopped; finished stages are kept in {out}, go on with --resume")
        raise
    finally:
        progress.close()
    return results


def load_study(data: str | Path | None, out: Path) -> BeamStudy:
    """The measured beam, or a virtual one made under ``out`` if there is none."""
    folder = find_dataset("silicone_beam", data)
    if folder is None:
        folder = write_beam_study(out / "virtual_beam")
    return load_beam_study(folder)


def _write_page(study: BeamStudy, results: dict[str, Any], out: Path) -> None:
    from diffsim.demo import measured_page
    from diffsim.viz import report as rp

    floor = results["measured"]["repeats"]
    page = rp.Report(
        title="Silicone beam: simulated against measured",
        subtitle=f"A clamped bar, released from straight; {len(study.trials)} recordings.",
        verdict=[
            f"{measured_page.case_title(case).capitalize()}: two repeats differ by "
            f"{1e3 * f['vertical_rms_m']:.2f} mm rms; no simulation can do better."
            for case, f in floor.items()
        ],
        banner=VIRTUAL_BANNER if study.is_virtual else None,
        sections=[measured_page.section(study, results["measured"])],
    )
    rp.write(page, out / "report.html")
