"""What a study describes otherwise than the one that a saved model was fitted to."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from diffsim.data.study import Study
from diffsim.diagnose.judge.described import (
    description_of,
    differences,
    require_same_kind,
    require_same_system,
)
from diffsim.identify.model_file import SavedModel
from tests.diagnose import linear

RIG = {
    "system": "rod",
    "gravity": [0.0, 0.0, -9.81],
    "parameters": {"mass": {"value": 1.2, "sd": 0.1}},
    "tendons": [{"name": "upper", "radius": 0.01}, {"name": "lower", "radius": 0.01}],
    "effects": {"without": ["drag"]},
}


def study(model) -> Study:
    return Study("later", "rod", linear.CHANNELS, (), model=model)


def saved(**more) -> SavedModel:
    facts = description_of(study(RIG))
    given = {"parameters": ("mass",), "facts": facts, "model": "rod", "study": "first"}
    return SavedModel(Path("m.yaml"), {}, {}, components=(), **{**given, **more})


def test_every_difference_is_said_by_its_place():
    assert differences(saved(), study(RIG)) == ()
    changed = {
        **RIG,
        "gravity": [0.0, -9.81, 0.0],
        "parameters": {"mass": {"value": 1.5, "sd": 0.1}},
        "tendons": [{"name": "lower", "radius": 0.02}, {"name": "upper", "radius": 0.01}],
        "effects": {},
        "payload": 0.1,
    }
    assert differences(saved(), study(changed)) == (
        "study.yaml: model.gravity is [0.0, -9.81, 0.0], the model was fitted with "
        "[0.0, 0.0, -9.81].",
        "study.yaml: model.parameters.mass.value is 1.5, the model was fitted with 1.2.",
        "study.yaml: model.payload is 0.1, the model was fitted with not stated.",
        "study.yaml: model.tendons.lower.radius is 0.02, the model was fitted with 0.01.",
    )
    # files of before hold no description
    assert differences(saved(facts={}), study(changed)) == ()


@pytest.mark.parametrize("gravity", [[0.0, 0.0, -9.61], [0.0, -1.62, 0.0]])
def test_another_gravity_cannot_be_meant(gravity):
    """Gravity of 9.61 for 9.81 was judged without a word."""
    with pytest.raises(ValueError, match=r"model.gravity is .*fitted with \[0.0, 0.0, -9.81\]"):
        differences(saved(), study({**RIG, "gravity": gravity}))


def test_another_system_cannot_be_meant():
    with pytest.raises(ValueError, match=r"fitted to system rod; .* has system ode"):
        require_same_kind(saved(), study({**RIG, "system": "ode"}))
    require_same_kind(saved(), study(RIG))
    require_same_kind(saved(facts={}), study({**RIG, "system": "ode"}))


def test_other_channels_cannot_be_meant():
    """It ended in a KeyError before any run was judged."""
    facts = {"noise": {"elsewhere": {}}, **description_of(study(RIG))}
    with pytest.raises(ValueError, match="fitted to channels elsewhere; study later has channel"):
        require_same_kind(saved(facts=facts), study(RIG))


def test_a_model_of_another_study_says_which_and_what_differs():
    """It said: parameter must be one of ['edge']."""
    box = SimpleNamespace(
        model=SimpleNamespace(name="rigid_body", base=[SimpleNamespace(name="edge@run_1")])
    )
    said = (
        r"m.yaml: a model of study first \(rod\), which study later \(rigid_body\) does not "
        "describe: no parameter mass there; it has edge"
    )
    with pytest.raises(ValueError, match=said):
        require_same_system(saved(), box, study(RIG))
    # the same name means nothing: it is that of the study, as its user chose it
    box.model.name = "rod"
    with pytest.raises(ValueError, match="no parameter mass there; it has edge"):
        require_same_system(saved(), box, study(RIG))
    same = SimpleNamespace(model=SimpleNamespace(name="bent", base=linear.model().base))
    assert require_same_system(saved(), same, study(RIG)) is None
