"""Causes that bend a law y = f(x): another exponent, zeros, limits, hysteresis, drift."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.core.expression import parse_expression
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect, Needs, needs_nothing
from diffsim.identify.model import SimModel
from diffsim.systems.ode.applying import Groups, by_formulas_in, labels_of, symbol
from diffsim.systems.ode.keys import Law
from diffsim.systems.ode.library import needs_order, require_kept
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.network import Change, Network, filled, named
from diffsim.systems.ode.scene import OdeScene

LEAST = 0.02  # of the usual x: below it a power is not raised
LAW_SCALES = "law_scales"  # place in a study's frame
_WAY, _LOOP, _SHARE = "way of the sweep", "loop of the sweep", "share of the run"


@dataclass(frozen=True)
class LawScale:
    """Usual magnitudes of a law in the plain model: rms of x and y, greatest y."""

    x: float
    y: float
    most: float


@dataclass(frozen=True, kw_only=True)
class _Bend:
    """A change of a law.

    Attributes:
        name: Name of the effect before that of the law.
        form, signed, smooth, also: As of the effect.
        formula: The law in y, x, its usual x0, greatest y most, other laws z, and size.
        typical: Size that would be no surprise.
        unit: Unit of the size, with Y and X for those of y and x.
        kind: Where it enters.
    """

    name: str
    form: str
    formula: str
    typical: float
    unit: str = "-"
    kind: str = "force"
    family: str = "law"
    signed: bool = True
    smooth: bool = True
    also: tuple[str, ...] = ()
    needs: Needs = needs_nothing


def _bends(law: Law, scale: LawScale, num_runs: int) -> Iterator[_Bend]:
    yield _Bend(
        name="exponent",
        form="The law grows with x to the power size beyond what it is.",
        formula="y*(max(x, least)/x0)**size",
        typical=0.1,
        also=("a coefficient that changes with the Reynolds number", "deformation under load"),
    )
    yield _Bend(
        name="growth",
        form="The law is 1 + size ((x / usual x)^2 - 1) times as large: more at large x.",
        formula="y*(1 + size*((x/x0)**2 - 1))",
        typical=0.1,
        also=("deformation under load", "saturation, if negative"),
    )
    yield _Bend(
        name="low_end_loss",
        form="The law is 1 - size (sqrt(usual x / x) - 1) times as large: less at small x.",
        formula="y*(1 - size*(sqrt(x0/max(x, least)) - 1))",
        typical=0.05,
        also=("viscous loss", "zero of the sensor"),
    )
    yield _Bend(
        name="linear_part",
        form="size x in addition.",
        formula="y + size*x",
        typical=0.05 * scale.y / scale.x,
        unit="Y/X",
        also=("viscous friction",),
    )
    yield _Bend(
        name="zero",
        form="size in addition wherever x is not 0.",
        formula="y + where(x, size, 0)",
        typical=0.02 * scale.y,
        unit="Y",
        family="zero",
        kind="sensor",
        also=("dry friction", "zero of the sensor"),
    )
    yield _Bend(
        name="gain",
        form="The law is 1 + size times as large.",
        formula="y*(1 + size)",
        typical=0.05,
        family="scale",
        kind="sensor",
        also=("scale of the sensor", "coefficient of the law"),
    )
    yield _Bend(
        name="limit",
        form="The law ends at 1 - size of its greatest value.",
        formula="min(y, most*(1 - size)) if size > 0 else y",
        typical=0.2,
        family="limit",
        signed=False,
        smooth=False,
        also=("range of the sensor",),
    )
    if law.sweeps:
        yield _Bend(
            name="hysteresis",
            form="The law is size larger on the way up and size smaller on the way down.",
            formula="y*(1 + size*way)",
            typical=0.02,
            family="hysteresis",
            also=("lag of the reading", "warming during the sweep"),
        )
        yield _Bend(
            name="hysteresis_loop",
            form="The law is less on the way up and more on the way down, by the share size of its "
            "greatest value halfway, by nothing where the sweep turns.",
            formula="y - size*most*loop",
            typical=0.01,
            family="hysteresis",
            also=("creep", "lag of the reading", "warming during the sweep"),
        )
    yield _Bend(
        name="run_drift",
        form="The law grows by the share size from the first to the last sample of a run.",
        formula="y*(1 + size*share)",
        typical=0.02,
        family="drift",
        kind="environment",
        also=("warming", "a battery that drains"),
    )
    yield _Bend(
        name="order_drift",
        form="The law grows by the share size from run to run.",
        formula="y*(1 + size*run_order)",
        typical=0.1 / max(num_runs, 1),
        unit="1/run",
        family="drift",
        kind="environment",
        also=("wear", "weather"),
        needs=needs_order,
    )


def check_laws(
    laws: Sequence[Law], definitions: Collection[str], known: Sequence[str], reader: Reader
) -> None:
    """Report laws that name no definition, or are of what is not there.

    Args:
        laws: Laws of the description.
        definitions: Names of definitions and tables.
        known: Names that formulas may use.
        reader: Receives the mistakes.
    """
    for i, law in enumerate(laws):
        if law.name not in definitions:
            reader.report(f"laws[{i}].name", f"no definition {law.name!r}; add it to define")
        reader.parse(f"laws[{i}].of", law.of, known)
        reader.require_per(f"laws[{i}]", law.per)


def labels_of_laws(laws: Sequence[Law], study: Study) -> dict[str, list[str]]:
    """Values of the facts that laws are sized by, as a study's ``frame`` keeps them."""
    pers = {law.per for law in laws if law.per is not None}
    return {per: list(labels_of(per, study)) for per in sorted(pers)}


def law_effects(
    laws: Sequence[Law],
    study: Study,
    scales: Mapping[str, LawScale],
    network: Network,
    known: Sequence[str],
) -> tuple[Effect, ...]:
    """Effects of every law, and of one law on another's reading.

    Args:
        laws: Laws of the description.
        study: Study with the recordings.
        scales: Usual magnitudes of each law, by its name (``law_scales``).
        network: Formulas of the plain model.
        known: Names that formulas may use.
    """
    num_runs = len({run.order for run in study.fit_runs})
    out = []
    for law in laws:
        scale = scales[law.name]
        out += [_effect(law, b, scale, study, network, known) for b in _bends(law, scale, num_runs)]
        for other in laws:
            if other.name != law.name:
                out.append(_crossed(law, other, scales, study, network, known))
    return tuple(out)


def _crossed(
    law: Law,
    other: Law,
    scales: Mapping[str, LawScale],
    study: Study,
    network: Network,
    known: Sequence[str],
) -> Effect:
    bend = _Bend(
        name=f"part_of_{other.name}",
        form=f"size of {other.name} is read with it.",
        formula=f"y + size*{other.name}",
        typical=0.02 * scales[law.name].y / scales[other.name].y,
        unit=f"{law.unit}/{other.unit}" if law.unit != other.unit else "-",
        family="cross_talk",
        kind="sensor",
    )
    return _effect(law, bend, scales[law.name], study, network, known)


def _effect(
    law: Law,
    bend: _Bend,
    scale: LawScale,
    study: Study,
    network: Network,
    known: Sequence[str],
) -> Effect:
    name = f"{bend.name}_of_{law.name}" if "_of_" not in bend.name else f"{bend.name}_in_{law.name}"
    numbers = {"x0": scale.x, "least": LEAST * scale.x, "most": scale.most}
    letters = ("y", "x", "size", "way", "loop", "share", *numbers)
    parts = {k: parse_expression(repr(v)) for k, v in numbers.items()} | {
        "y": named(law.name),
        "x": parse_expression(law.of, known),
        "size": named(symbol(name)),
        "way": named(_WAY + " of " + law.name),
        "loop": named(_LOOP + " of " + law.name),
        "share": named(_SHARE),
    }
    formula = parse_expression(bend.formula, (*letters, *known))
    further = [parts[k].text for k in ("way", "loop", "share") if k in formula.names]
    change = Change(names={law.name: filled(formula, parts)}, inputs=tuple(further))
    groups = Groups.of(law.per, study)
    return Effect(
        name=name,
        form=f"{law.name}: {bend.form}",
        family=f"{bend.family}_of_{law.name}",
        kind=bend.kind,
        unit=bend.unit.replace("Y", law.unit).replace("X", law.of_unit),
        typical=bend.typical,
        signed=bend.signed,
        smooth=bend.smooth,
        also_looks_like=bend.also,
        needs=bend.needs,
        components=groups.components,
        apply=_Bent(
            by_formulas_in(change, symbol(name), groups),
            tuple(further),
            network.with_readings({"x": parts["x"]}),
        ),
    )


@dataclass(frozen=True, eq=False)
class _Bent:
    """Applies a change of a law, with the signals that it needs beside the formulas.

    Attributes:
        plain: The change of formulas.
        further: Names of those signals.
        swept: Formulas that read x.
    """

    plain: Apply
    further: tuple[str, ...]
    swept: Network

    def __call__(self, scene: OdeScene, size: Tensor, run: Run) -> OdeScene:
        signals = {name: self._signal(name, scene) for name in self.further}
        scene = self.plain(scene, size, run)
        return replace(scene, inputs={**scene.inputs, **signals})

    def _signal(self, name: str, scene: OdeScene) -> Tensor:
        """Share of the run; 1 where x rises, -1 where it falls; or that, fading to both ends."""
        if name == _SHARE:
            return _share(scene)
        x = replace(scene, changes=()).solved(self.swept)[0]
        path = x.reshape(-1, x.shape[-2])[0].detach().numpy()
        way = np.sign(np.gradient(path))
        if name.startswith(_LOOP):
            reach = float(np.ptp(path)) or 1.0
            place = (path - path.min()) / reach
            way *= 4.0 * place * (1.0 - place)
        return torch.from_numpy(way)


def _share(scene: OdeScene) -> Tensor:
    since = scene.grid.times - scene.grid.times[0]
    return since / since[-1] if since[-1] > 0.0 else since


def law_scales(
    laws: Sequence[Law], study: Study, model: SimModel, network: Network, known: Sequence[str]
) -> dict[str, LawScale]:
    """Usual magnitudes of laws, from one simulation of each run to fit.

    A study with a ``frame`` has them from there.

    Args:
        laws: Laws of the description.
        study: Study with the recordings.
        model: Plain model.
        network: Its formulas.
        known: Names that formulas may use.
    """
    if not laws:
        return {}
    if LAW_SCALES in study.frame:
        kept = {name: LawScale(**scale) for name, scale in study.frame[LAW_SCALES].items()}
        require_kept("law", [law.name for law in laws], kept)
        return kept
    pairs = [(law, w) for law in laws for w in (law.of, law.name)]
    read = network.with_readings(
        {f"{law.name} {w}": parse_expression(w, known) for law, w in pairs}
    )
    columns: list[np.ndarray] = []
    for run in study.fit_runs or study.runs:
        scene = model.scene(run, model.at_prior())
        assert isinstance(scene, OdeScene)
        with torch.no_grad():
            columns.append(scene.solved(read)[0].numpy())
    table = dict(zip(read.readings, np.concatenate(columns).T, strict=True))

    def rms(values: np.ndarray) -> float:
        seen = values[np.isfinite(values)]
        found = float(np.sqrt(np.mean(seen**2))) if len(seen) else 0.0
        return found if np.isfinite(found) and found > 0.0 else 1.0

    out = {}
    for law in laws:
        x, y = table[f"{law.name} {law.of}"], table[f"{law.name} {law.name}"]
        out[law.name] = LawScale(rms(x), rms(y), float(np.nanmax(y)))
    return out
