"""Causes that bend a law y = f(x): another exponent, zeros, limits, hysteresis, drift."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.row import Row
from diffsim.causes.scales import Scales
from diffsim.core.expression import Expression, parse_expression
from diffsim.core.schema import fill_in
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown, UnknownLaw
from diffsim.systems.ode.applying import RunGroups, by_formulas_in, labels_of, symbol
from diffsim.systems.ode.keys import Law
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.network import Change, Network, filled, named
from diffsim.systems.ode.scene import OdeScene

LEAST = 0.02  # of the usual x: below it a power is not raised
_WAY, _LOOP, _SHARE = "way of the sweep", "loop of the sweep", "share of the run"


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
    scales: Scales,
    network: Network,
    known: Sequence[str],
) -> tuple[Effect, ...]:
    """Effects of every law, and of one law on another's reading.

    Args:
        laws: Laws of the description.
        study: Study with the recordings.
        scales: Usual magnitudes, those of laws among them (``law_scales``).
        network: Formulas of the plain model.
        known: Names that formulas may use.
    """
    bend = _Bender(study, scales, network, tuple(known))
    out = []
    for law in laws:
        for row in rows("law").values():
            if row.name != "part" and (law.sweeps or "hysteresis" not in row.name):
                out.append(bend.effect(law, row))
        out += [bend.effect(law, rows("law")["part"], o) for o in laws if o.name != law.name]
    return tuple(out)


def unknown_laws(
    laws: Sequence[Law], study: Study, model: SimModel, network: Network, known: Sequence[str]
) -> tuple[Unknown, ...]:
    """What nobody listed may depend on the same as a law: on its x, and on the place in a sweep.

    Args:
        laws: Laws of the description.
        study: Study with the recordings.
        model: Plain model.
        network: Its formulas.
        known: Names that formulas may use.
    """
    places = {channel.name: i for i, channel in enumerate(study.channels)}
    out: dict[str, Unknown] = {}
    for law in laws:
        read = network.with_readings({"x": parse_expression(law.of, known)})
        for name in network.channels_with(law.name):
            said = f"unknown law of {name} over {law.of}"
            out[said] = UnknownLaw(places[name], said, _FollowedPath(model, read))
            if law.sweeps:
                said = f"unknown course of {name} over a sweep"
                out[said] = UnknownLaw(places[name], said, _share_of_samples)
    return tuple(out.values())


def _share_of_samples(run: Run) -> np.ndarray:
    return np.linspace(0.0, 1.0, len(run.time_s))


@dataclass(frozen=True, eq=False)
class _FollowedPath:
    """Gives x of a law in a run, by the plain model as it is described.

    Attributes:
        model: Plain model.
        read: Its formulas, which read x.
    """

    model: SimModel
    read: Network

    def __call__(self, run: Run) -> np.ndarray:
        scene = self.model.scene(run, self.model.at_prior())
        assert isinstance(scene, OdeScene)
        with torch.no_grad():
            x = scene.solved(self.read)[0][..., 0]
        return x.reshape(-1, x.shape[-1])[0][scene.grid.samples].numpy()


@dataclass(frozen=True, eq=False)
class _Bender:
    """Makes effects that bend laws.

    Attributes:
        study: Study with the recordings.
        scales: Usual magnitudes, those of laws among them.
        network: Formulas of the plain model.
        known: Names that formulas may use.
    """

    study: Study
    scales: Scales
    network: Network
    known: tuple[str, ...]

    def effect(self, law: Law, row: Row, other: Law | None = None) -> Effect:
        """A cause of a law.

        Args:
            law: The law.
            row: Row of the cause.
            other: Law that is read with it, of the cause ``part``.
        """
        if other is None:
            name, said = f"{row.name}_of_{law.name}", row.form
        else:
            name, said = (
                f"part_of_{other.name}_in_{law.name}",
                fill_in(row.form, {"other": other.name}),
            )
        parts = self._list_letters(law, name, other)
        formula = parse_expression(row.said("law"), (*parts, *self.known))
        further = [parts[k].text for k in ("way", "loop", "share") if k in formula.names]
        change = Change(names={law.name: filled(formula, parts)}, inputs=tuple(further))
        groups = RunGroups.of(law.per, self.study)
        swept = self.network.with_readings({"x": parts["x"]})
        apply = _BentLaw(by_formulas_in(change, symbol(name), groups), tuple(further), swept)
        return row.effect(
            apply,
            self._list_magnitudes(law, other),
            name=name,
            form=f"{law.name}: {said}",
            family=f"{row.family}_of_{law.name}",
            unit=_compute_unit(row.unit, law, other),
            components=groups.components,
        )

    def _list_magnitudes(self, law: Law, other: Law | None) -> dict[str, float]:
        runs = float(max(len({run.order for run in self.study.fit_runs}), 1))
        own = {**self.scales.plain[f"law {law.name}"], "runs": runs}
        return own if other is None else {**own, "z": self.scales.plain[f"law {other.name}"]["y"]}

    def _list_letters(self, law: Law, name: str, other: Law | None) -> dict[str, Expression]:
        """What the letters of a law's formula stand for."""
        scale = self.scales.plain[f"law {law.name}"]
        numbers = {"x0": scale["x"], "least": LEAST * scale["x"], "most": scale["most"]}
        return {
            **{k: parse_expression(repr(v)) for k, v in numbers.items()},
            **({} if other is None else {"other": named(other.name)}),
            "y": named(law.name),
            "x": parse_expression(law.of, self.known),
            "size": named(symbol(name)),
            "way": named(_WAY + " of " + law.name),
            "loop": named(_LOOP + " of " + law.name),
            "share": named(_SHARE),
        }


def _compute_unit(pattern: str, law: Law, other: Law | None) -> str:
    """Unit of a size: "Y/X" is that of y over that of x."""
    if other is not None:
        return f"{law.unit}/{other.unit}" if law.unit != other.unit else "-"
    return pattern.replace("Y", law.unit).replace("X", law.of_unit)


@dataclass(frozen=True, eq=False)
class _BentLaw:
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
        signals = {name: self._fill_signal(name, scene) for name in self.further}
        scene = self.plain(scene, size, run)
        return replace(scene, inputs={**scene.inputs, **signals})

    def _fill_signal(self, name: str, scene: OdeScene) -> Tensor:
        """Share of the run; 1 where x rises, -1 where it falls; or that, fading to both ends."""
        if name == _SHARE:
            return _compute_share_of_run(scene)
        x = replace(scene, changes=()).solved(self.swept)[0]
        path = x.reshape(-1, x.shape[-2])[0].detach().numpy()
        way = np.sign(np.gradient(path))
        if name.startswith(_LOOP):
            reach = float(np.ptp(path)) or 1.0
            place = (path - path.min()) / reach
            way *= 4.0 * place * (1.0 - place)
        return torch.from_numpy(way)


def _compute_share_of_run(scene: OdeScene) -> Tensor:
    since = scene.grid.times - scene.grid.times[0]
    return since / since[-1] if since[-1] > 0.0 else since


def law_scales(
    laws: Sequence[Law], study: Study, model: SimModel, network: Network, known: Sequence[str]
) -> dict[str, Mapping[str, float]]:
    """Usual magnitudes of laws by "law NAME": rms of x and y, greatest y; from one simulation of
    each run to fit.

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
    if (kept := Scales.kept_in(study)) is not None:
        names = [f"law {law.name}" for law in laws]
        kept.require_plain("magnitudes of", names)
        return {name: kept.plain[name] for name in names}
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

    out: dict[str, Mapping[str, float]] = {}
    for law in laws:
        x, y = table[f"{law.name} {law.of}"], table[f"{law.name} {law.name}"]
        most = float(np.nanmax(y))
        out[f"law {law.name}"] = {"x": rms(x), "y": rms(y), "most": most}
    return out
