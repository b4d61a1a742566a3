"""What cannot be simulated ends no diagnosis: a candidate that cannot be moved is not judged, a set
that diverges on runs which choose between causes is not named."""

from dataclasses import replace

import pytest

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.identify import DiagnosisSettings, SearchSettings
from tests.diagnose import linear
from tests.diagnose.say.test_causes import PUSH, causes, recorded


def test_a_candidate_that_cannot_be_moved_is_not_judged():
    def burst(scene, size, run):
        return replace(scene, record=scene.record + (1e300 * size) ** 3)

    wild = replace(linear.line("wild"), apply=burst)
    runs = tuple(recorded(f"r{k}", k, {PUSH: 3.0}) for k in range(6))
    study = Study("lines", "copter", linear.CHANNELS, runs)
    settings = DiagnosisSettings(search=SearchSettings(num_refits=4))
    report = diagnose(study, linear.model(), (wild, PUSH), seed=0, settings=settings)
    assert report.named == ("push",)
    row = causes(report)["wild"]
    assert row.status == "not judged" and "not even a small size" in row.note


def test_a_candidate_that_cannot_be_moved_beside_others_is_not_judged():
    """Alone it can be: a scene that another candidate makes, at zero, takes other steps."""

    class Marked(linear.LinearScene):
        pass

    def mark(scene, size, run):
        return Marked(PUSH.apply(scene, size, run).record)

    def burst(scene, size, run):
        factor = 1e300 if isinstance(scene, Marked) else 1.0
        return replace(scene, record=scene.record + (factor * size) ** 3)

    push, wild = replace(PUSH, apply=mark), replace(linear.line("wild"), apply=burst)
    runs = tuple(recorded(f"r{k}", k, {PUSH: 3.0}) for k in range(6))
    study = Study("lines", "copter", linear.CHANNELS, runs)
    settings = DiagnosisSettings(search=SearchSettings(num_refits=4))
    report = diagnose(study, linear.model(), (push, wild), seed=0, settings=settings)
    assert report.named == ("push",)
    assert causes(report)["wild"].status == "not judged"


@pytest.mark.parametrize("use", ["select", "test"])
def test_a_set_that_diverges_on_unseen_runs_is_not_named(use):
    """It explains fitted runs; where runs choose it is withdrawn, where they judge it is said."""

    def burst(scene, size, run):
        pushed = replace(scene, record=scene.record + linear.shapes("push", run) @ size)
        return pushed if run.use == "fit" else replace(pushed, record=pushed.record / 0.0)

    wild = replace(linear.line("wild"), apply=burst)
    runs = tuple(recorded(f"r{k}", k, {PUSH: 3.0}) for k in range(6))
    runs = (*runs, recorded("unseen", 9, {PUSH: 3.0}, use=use))
    study = Study("lines", "copter", linear.CHANNELS, runs)
    settings = DiagnosisSettings(search=SearchSettings(num_refits=4))
    report = diagnose(study, linear.model(), (wild,), seed=0, settings=settings)
    if use == "select":
        assert report.verdict == "unknown" and report.named == ()
        assert causes(report)["wild"].status == "refuted"
    else:
        assert "could not be simulated" in " ".join((report.headline, *report.sentences))
