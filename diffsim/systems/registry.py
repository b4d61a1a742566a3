"""Systems by name: the setup of a study, saved models.

A study describes its system under ``model:``, ``model: {system: ode, ...}``; the classes of
``DESCRIPTIONS`` read that, each imported when asked for. Packages of users add kinds of systems by
entry points of the group ``diffsim.systems``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

from diffsim.causes.law_port import PortLaws
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.plugins import SYSTEMS, find_plugins, load_plugin
from diffsim.core.schema import read_part
from diffsim.data.study import Study
from diffsim.identify.extended import ExtendedModel
from diffsim.identify.law import LAWS
from diffsim.identify.model_file import read_extended, rebuilt
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import Description

#: Kind of system -> module and class of its description.
DESCRIPTIONS = {
    "bench": ("diffsim.systems.bench.description", "BenchDescription"),
    "flow_device": ("diffsim.systems.flow_network.device_description", "FlowDeviceDescription"),
    "flow_network": ("diffsim.systems.flow_network.description", "FlowNetworkDescription"),
    "multicopter": ("diffsim.systems.multicopter.description", "MulticopterDescription"),
    "ode": ("diffsim.systems.ode.description", "OdeDescription"),
    "outside": ("diffsim.systems.outside.description", "OutsideDescription"),
    "rigid_body": ("diffsim.systems.rigid_body.description", "RigidBodyDescription"),
    "rod": ("diffsim.systems.rod.description", "RodDescription"),
    "soft_body": ("diffsim.systems.soft_body.description", "SoftBodyDescription"),
}


def known_systems() -> tuple[str, ...]:
    """Kinds of systems by name, those of other packages among them.

    Raises:
        ValueError: another package gives a kind the name of one of this package.
    """
    added = find_plugins(SYSTEMS)
    if taken := sorted(set(added) & set(DESCRIPTIONS)):
        raise ValueError(
            f"{SYSTEMS}: {taken[0]!r} is a system of diffsim already; give "
            f"{added[taken[0]].value} another name"
        )
    return (*DESCRIPTIONS, *added)


def description_class(system: str) -> type[Description]:
    """Class that reads ``model:`` of a kind of system.

    Args:
        system: One of ``known_systems()``.

    Raises:
        ValueError: no such kind, or one that another package cannot give.
    """
    if system not in DESCRIPTIONS:
        added: type[Description] = load_plugin(SYSTEMS, system, Description)
        return added
    module, name = DESCRIPTIONS[system]
    own: type[Description] = getattr(import_module(module), name)
    return own


def description_of(study: Study) -> Description:
    """The description of a study's system, every key checked.

    Args:
        study: Study with ``model``.

    Raises:
        ValueError: no model, no such system, or keys that are wrong; the message has a line for
            each, with its path in the file.
    """
    where = "study.yaml: model" if study.file is None else f"{study.file}: model"
    if study.model is None:
        raise ValueError(
            f"study {study.name} has no model; describe its system under ``model:`` (one of "
            f"{', '.join(known_systems())}), or bring your own: diffsim diagnose --setup FILE.py, "
            "diffsim.diagnose.diagnose"
        )
    if "system" not in study.model:
        raise ValueError(f"{where} has no system; name one of {', '.join(known_systems())}")
    system = require_choice(f"{where}.system", str(study.model["system"]), known_systems())
    made: Description = read_part(description_class(system), study.model, where)
    return made


@checked
def setup_of(study: Study) -> DiagnosisSetup:
    """The setup of a study, as its description makes it.

    Args:
        study: Study with ``model``.

    Raises:
        ValueError: no model, or one that is wrong.
    """
    return _setup_without_tests(description_of(study), study)


def _setup_without_tests(described: Description, study: Study) -> DiagnosisSetup:
    """Causes, priors and scales as runs that are not for testing give them; a model for all runs.

    A test run must change nothing before the answer is frozen. So it is not there when causes are
    listed and their usual sizes are taken; the model knows it, framed by what the others gave.
    """
    known = study.without_tests()
    if len(known.runs) in (0, len(study.runs)):  # runs to be judged by a saved model have its frame
        return _offer_laws(_make(described, study), described, study)
    seen = _make(described, known)
    whole = _make(described, replace(study, frame={**seen.model.frame, **study.frame}))
    of_all = {effect.name: effect for effect in whole.effects}
    effects = list(seen.effects)
    for i, effect in enumerate(effects):
        # one that differs from run to run has what is a test run's own, "@run": it is fitted to the
        # run itself, after the answer
        there = of_all.get(effect.name, effect)
        more = set(there.components) - set(effect.components)
        if more and all(name.startswith("@") for name in more):
            effects[i] = replace(there, typical=effect.typical)
    made = replace(seen, effects=tuple(effects))
    laws = _offer_laws(made, described, study).laws
    return replace(made, model=whole.model, laws=laws, study=whole.study)


def _make(described: Description, study: Study) -> DiagnosisSetup:
    """A setup with laws that were found, those of the study's frame, among the causes."""
    stated = [c.name for c in study.commands if c.before is not None]
    if stated and not described.takes_before:
        raise ValueError(
            f"commands: before of {', '.join(stated)}: system {described.system} takes the first "
            "value of a run for what was commanded before; leave it out"
        )
    found = study.frame.get(LAWS)
    if found and not described.effects.holds(found):
        described = described.model_copy(update={"effects": described.effects.joined(found)})
    made = described.setup(study)
    if found:
        made.model.frame = {**made.model.frame, LAWS: found}
    return replace(made, model=made.model.with_shapes_of(made.effects))


def _offer_laws(made: DiagnosisSetup, described: Description, study: Study) -> DiagnosisSetup:
    """A setup with a port for laws that nobody listed: the system's own, or that of its plant."""
    if not described.effort.unlisted_laws:
        return replace(made, laws=None)
    make = partial(_setup_without_tests, described)
    if made.laws is not None:
        return replace(made, laws=made.laws.made_by(make, study))
    if type(described).plant is Description.plant:
        return made
    known = study.without_tests() if study.without_tests().runs else study
    laws = PortLaws(
        offered=partial(described.plant, known),
        study=made.study or known,
        model=made.model,
        whole=study,
        make=make,
    )
    return replace(made, laws=laws)


@checked
def load_extended(
    path: str | Path, study: Study, *, setup: DiagnosisSetup | None = None
) -> ExtendedModel:
    """The saved model, ready to be simulated, differentiated or fitted further.

    Args:
        path: ``extended_model.yaml`` or the folder that holds it.
        study: Study of the system; its setup gives the plain model and the effects by name.
            Nuisances of runs that the file does not know ("offset@run_9") keep their prior.
        setup: Setup to use in place of the study's own; where causes depend on recordings, made
            for the framed study, ``read_extended(path).framed(study)``.

    Returns:
        A model whose priors are centered at the saved values.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an effect or parameter that the setup does not have; the message names the
            closest ones.
    """
    saved = read_extended(path)
    return rebuilt(saved, setup_of(saved.framed(study)) if setup is None else setup)
