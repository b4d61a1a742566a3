"""Does the loop keep its books, resume without repeating experiments, and swim faster?"""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from diffsim.data.study import Run
from labs.loop import (
    AwaitingRecordingError,
    Command,
    FitSettings,
    Limits,
    LoopSettings,
    Starfish,
    TrajectorySettings,
    VirtualLaboratory,
    sim_to_real,
)
from labs.loop.recordings import COMMAND

LIMITS = Limits()
SINE = Command(0.005 * (1.0 - np.cos(2.0 * np.pi * np.arange(30) / 30)))
TINY = LoopSettings(
    max_iterations=2,
    tolerance=0.0,
    fit=FitSettings(duration_s=0.3, max_evaluations=2),
    trajectory=TrajectorySettings(periods=1, num_knots=10, max_evaluations=2),
)


@dataclass
class Twin:
    """The model with other parameters; counts experiments and refuses those in ``missing``."""

    missing: set[int] = field(default_factory=set)
    executed: list[int] = field(default_factory=list)
    name = "twin"
    virtual = True
    duration_s = 1.0
    limits = LIMITS

    def execute(self, command: Command, *, order: int) -> Run:
        if order in self.missing:
            raise AwaitingRecordingError("not yet")
        self.executed.append(order)
        model = Starfish()
        values = {p.name: p.value for p in model.parameters} | {"youngs_modulus": 5e5}
        wish = command.during(self.duration_s)
        with torch.no_grad():
            places = model.motion(values, torch.from_numpy(wish)).numpy()[:, :-1]
        name = f"run_{order}"
        return Run(name, np.arange(len(wish)) / 60.0, places, {COMMAND: wish}, name, order)


@pytest.fixture(scope="module")
def resumed(tmp_path_factory):
    """A loop that was interrupted before experiment 1, resumed, then resumed when all was done."""
    folder, twin = tmp_path_factory.mktemp("loops") / "loop", Twin(missing={1})
    with pytest.raises(AwaitingRecordingError):
        sim_to_real(Starfish(), twin, SINE, folder, TINY, progress=False)
    planned = (folder / "iteration_1/plan.json").read_text()
    twin.missing = set()
    first = sim_to_real(Starfish(), twin, SINE, folder, TINY, resume=True, progress=False)
    again = sim_to_real(Starfish(), twin, SINE, folder, TINY, resume=True, progress=False)
    assert (folder / "iteration_1/plan.json").read_text() == planned
    return folder, twin, first, again


@pytest.mark.cpu(12)  # the loop of all tests here: three experiments, two fits, two searches
def test_no_experiment_is_repeated(resumed):
    assert resumed[1].executed == [0, 1, 2]


def test_a_finished_loop_is_read_back_as_it_was(resumed):
    _, _, first, again = resumed
    for a, b in zip(first.iterations, again.iterations, strict=True):
        assert a.values == b.values
        assert (a.speed_measured, a.loss_action) == (b.speed_measured, b.loss_action)
        assert a.loss_theta == pytest.approx(b.loss_theta, rel=1e-12)
        np.testing.assert_array_equal(a.command.contraction_m, b.command.contraction_m)
        np.testing.assert_array_equal(a.run.measured, b.run.measured)


def test_books(resumed):
    result = resumed[2]
    assert [i.idx for i in result.iterations] == [0, 1, 2]
    assert (np.diff(result.best_so_far) >= 0.0).all()
    assert result.best.speed_measured == result.best_so_far[-1]
    assert result.best.speed_measured > result.iterations[0].speed_measured + 1e-3  # [m/s]
    assert result.iterations[0].identified is None
    for it in result.iterations[1:]:
        assert it.identified is not None
        assert it.loss_theta == it.identified.loss_after
        assert it.loss_action <= it.loss_action_before  # thesis: minimize over a, theta fixed
        it.command.check(LIMITS)
    first = result.iterations[1].identified  # later ones weigh a smaller misfit against the prior
    assert first.loss_after < first.loss_before


def test_a_loop_is_not_overwritten_nor_mixed_with_another(resumed):
    folder, twin = resumed[:2]
    with pytest.raises(FileExistsError, match="resume"):
        sim_to_real(Starfish(), twin, SINE, folder, TINY, progress=False)
    with pytest.raises(ValueError, match="another model"):
        sim_to_real(Starfish(dt_s=1 / 30), twin, SINE, folder, TINY, resume=True, progress=False)
    assert twin.executed == [0, 1, 2]


def test_report(resumed, tmp_path):
    pytest.importorskip("matplotlib", reason="needs the extra viz")
    pytest.importorskip("plotly", reason="needs the extra viz")
    pytest.importorskip("jinja2", reason="needs the extra viz")
    from labs.loop.report import write_loop

    found = resumed[2].iterations[-1].identified
    row = {"run": "baseline", "use": "fit", "rms_before_m": 0.01, "rms_after_m": 0.002}
    real = {"runs": [row | {"rms_still_m": 0.004}], **found.plain()}
    page = write_loop(resumed[2], Starfish(), tmp_path, fit_s=0.3, real=real)
    text = page.read_text()
    assert "measured robot" in text and "10.00" in text
    assert "bl-one-iter" in text and "Virtual hardware" in text
    assert "Correlations of the last identification" in text
    for name in ("speeds", "markers", "travel", "commands", "strip"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5_000
        assert (tmp_path / f"{name}.svg").exists()
    assert (tmp_path / "table_5_2.json").exists()


@pytest.mark.slow
def test_one_iteration_beats_the_hand_made_command_in_the_laboratory(tmp_path):
    lab = VirtualLaboratory(duration_s=2.0, limits=LIMITS)
    settings = LoopSettings(
        max_iterations=1,
        fit=FitSettings(duration_s=0.8, max_evaluations=8),
        trajectory=TrajectorySettings(periods=2, num_knots=15, max_evaluations=12),
    )
    result = sim_to_real(Starfish(), lab, SINE, tmp_path / "loop", settings, progress=False)
    control, one = result.iterations
    assert one.speed_measured > control.speed_measured + 1e-3  # [m/s]
