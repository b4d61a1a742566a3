"""Stages are kept, read back only when nothing they depend on changed."""

import numpy as np

from examples.demo.stages import Stages


def run(folder, settings, *, resume, calls, first=1):
    def stage(name, value):
        calls.append(name)
        return {"value": np.float64(value)}

    stages = Stages(folder, settings, resume=resume)
    a = stages.run("a", lambda: stage("a", first), first=first)
    b = stages.run("b", lambda: stage("b", a["value"] + 1))
    return b["value"], stages.reused


def test_resume_reuses_what_is_unchanged(tmp_path):
    calls: list[str] = []
    assert run(tmp_path, {"h": 1}, resume=False, calls=calls) == (2.0, [])
    assert run(tmp_path, {"h": 1}, resume=True, calls=calls) == (2.0, ["a", "b"])
    assert calls == ["a", "b"]
    assert run(tmp_path, {"h": 1}, resume=False, calls=calls)[1] == []  # asked for anew
    assert run(tmp_path, {"h": 2}, resume=True, calls=calls)[1] == []  # settings changed
    assert run(tmp_path, {"h": 2}, resume=True, calls=calls, first=5) == (6.0, [])  # upstream


def test_a_broken_stage_file_is_computed_again(tmp_path):
    run(tmp_path, {}, resume=False, calls=[])
    (tmp_path / "stages" / "b.json").write_text("{ half")
    calls: list[str] = []
    assert run(tmp_path, {}, resume=True, calls=calls) == (2.0, ["a"])
    assert calls == ["b"]
