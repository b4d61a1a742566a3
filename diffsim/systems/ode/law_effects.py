"""Causes that bend a law y = f(x): another exponent, zeros, limits, hysteresis, drift."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.row import Row
from diffsim.core.expression import Expression, parse_expression
from diffsim.core.schema import fill_in
from diffsim.data.study import Run
from diffsim.identify.effect import Apply, Effect
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown, UnknownLaw
from diffsim.systems.ode.applying import RunGroups, apply_in_group, symbol
from diffsim.systems.ode.keys import Law
from diffsim.systems.ode.library import Library, law_key
from diffsim.systems.ode.network import Change, Network, filled, named
from diffsim.systems.ode.scene import OdeScene

LEAST = 0.02  # of the usual x: below it a power is not raised
_WAY, _LOOP, _SHARE = "way of the sweep", "loop of the sweep", "share of the run"


def law_effects(library: Library) -> tuple[Effect, ...]:
    """Effects of every law, and of one law on another's reading."""
    laws, out = library.system.keys.laws, []
    for law in laws:
        for row in rows("law").values():
            if row.name != "part" and (law.sweeps or "hysteresis" not in row.name):
                out.append(_bend(library, law, row))
        out += [_bend(library, law, rows("law")["part"], o) for o in laws if o.name != law.name]
    return tuple(out)


def unknown_laws(library: Library) -> tuple[Unknown, ...]:
    """What nobody listed may depend on the same as a law: on its x, and on the place in a sweep."""
    system = library.system
    places = {channel.name: i for i, channel in enumerate(library.study.channels)}
    out: dict[str, Unknown] = {}
    for law in system.keys.laws:
        read = system.network.with_readings({"x": parse_expression(law.of, system.known)})
        for name in system.network.channels_with(law.name):
            said = f"unknown law of {name} over {law.of}"
            out[said] = UnknownLaw(places[name], said, _FollowedPath(library.model, read))
            if law.sweeps:
                said = f"unknown course of {name} over a sweep"
                out[said] = UnknownLaw(places[name], said, _share_of_samples)
    return tuple(out.values())


def _share_of_samples(run: Run) -> np.ndarray:
    return np.linspace(0.0, 1.0, len(run.time_s))


@dataclass(frozen=True, eq=False)
class _FollowedPath:
    """Gives x of a law in a run, by the plain model as it is described."""

    model: SimModel
    read: Network

    def __call__(self, run: Run) -> np.ndarray:
        scene = self.model.scene(run, self.model.at_prior())
        assert isinstance(scene, OdeScene)
        with torch.no_grad():
            x = scene.solved(self.read)[0][..., 0]
        return x[scene.grid.samples].numpy()


def _bend(library: Library, law: Law, row: Row, other: Law | None = None) -> Effect:
    """A cause of a law; ``other`` is the law that is read with it, of the cause ``part``."""
    system = library.system
    if other is None:
        name, said = f"{row.name}_of_{law.name}", row.form
        unit = row.unit.replace("Y", law.unit).replace("X", law.of_unit)  # "Y/X": y over x
    else:
        name, said = f"part_of_{other.name}_in_{law.name}", fill_in(row.form, {"other": other.name})
        unit = f"{law.unit}/{other.unit}" if law.unit != other.unit else "-"
    parts = _list_letters(library, law, name, other)
    formula = parse_expression(row.said("law"), (*parts, *system.known))
    further = {parts[k].text: False for k in ("way", "loop", "share") if k in formula.names}
    change = Change(names={law.name: filled(formula, parts)}, inputs=further)
    groups = RunGroups.of(law.per, library.study)
    swept = system.network.with_readings({"x": parts["x"]})
    bend = partial(apply_in_group, change=change, symbol=symbol(name), groups=groups)
    apply = _BentLaw(bend, tuple(further), swept)
    return row.effect(
        apply,
        _list_magnitudes(library, law, other),
        name=name,
        form=f"{law.name}: {said}",
        family=f"{row.family}_of_{law.name}",
        unit=unit,
        components=groups.components,
    )


def _list_magnitudes(library: Library, law: Law, other: Law | None) -> dict[str, float]:
    plain = library.scales.plain
    runs = float(max(len({run.order for run in library.study.fit_runs}), 1))
    own = {**plain[law_key(law)], "runs": runs}
    return own if other is None else {**own, "z": plain[law_key(other)]["y"]}


def _list_letters(
    library: Library, law: Law, name: str, other: Law | None
) -> dict[str, Expression]:
    """What the letters of a law's formula stand for."""
    scale = library.scales.plain[law_key(law)]
    numbers = {"x0": scale["x"], "least": LEAST * scale["x"], "most": scale["most"]}
    return {
        **{k: parse_expression(repr(v)) for k, v in numbers.items()},
        **({} if other is None else {"other": named(other.name)}),
        "y": named(law.name),
        "x": parse_expression(law.of, library.system.known),
        "size": named(symbol(name)),
        "way": named(_WAY + " of " + law.name),
        "loop": named(_LOOP + " of " + law.name),
        "share": named(_SHARE),
    }


@dataclass(frozen=True, eq=False)
class _BentLaw:
    """Applies a change of a law, with the signals that it needs beside the formulas."""

    plain: Apply
    further: tuple[str, ...]
    swept: Network

    def __call__(self, scene: OdeScene, size: Tensor, run: Run) -> OdeScene:
        signals = {name: self._fill_signal(name, scene) for name in self.further}
        scene = self.plain(scene, size, run)
        return scene.changed(further={**scene.further, **signals})

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
