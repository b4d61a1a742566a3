"""What cannot be simulated ends no diagnosis: a candidate that cannot be moved is not judged, a set
that diverges on runs which choose between causes is not named."""

from dataclasses import replace

import pytest

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.identify import DiagnosisSettings, SearchSettings
from tests.diagnose import linear
from tests.diagnose.say.test_causes import PUSH, causes, recorded


class Marked(linear.LinearScene):
    """What another candidate makes, at zero, too: it takes other steps."""


@pytest.mark.parametrize("is_alone", [True, False])
def test_a_candidate_that_cannot_be_moved_is_not_judged(is_alone):
    def mark(scene, size, run):
        return Marked(PUSH.apply(scene, size, run).record)

    def burst(scene, size, run):
        factor = 1e300 if is_alone or isinstance(scene, Marked) else 1.0
        return replace(scene, record=scene.record + (factor * size) ** 3)

    wild, push = replace(linear.line("wild"), apply=burst), replace(PUSH, apply=mark)
    found = (wild, PUSH) if is_alone else (push, wild)
    runs = tuple(recorded(f"r{k}", k, {PUSH: 3.0}) for k in range(6))
    study = Study("lines", "copter", linear.CHANNELS, runs)
    settings = DiagnosisSettings(search=SearchSettings(num_refits=4))
    report = diagnose(study, linear.model(), found, seed=0, settings=settings)
    assert report.named == ("push",)
    row = causes(report)["wild"]
    assert row.status == "not judged" and (not is_alone or "not even a small size" in row.note)


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
