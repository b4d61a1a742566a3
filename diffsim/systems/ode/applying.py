"""How effects reach a scene: where terms enter its formulas, with which sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from torch import Tensor

from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply
from diffsim.systems.ode.described import FormulaSystem
from diffsim.systems.ode.keys import Law, OwnEffect
from diffsim.systems.ode.network import READING, Change, filled, named
from diffsim.systems.ode.scene import OdeScene


def symbol(effect: str) -> str:
    """What the size of an effect is called in formulas that users cannot write."""
    return f"size of {effect}"


def entering(system: FormulaSystem, kind: str, target: str, term: Expression) -> Change:
    """A term where it enters a system.

    A force is added to what is the force at its place, or to the rate of the velocity.

    Args:
        system: The description with its formulas parsed.
        kind: What the target is: force (at a place), rate (of a state), reading (of a channel),
            number (whose share the term is), input, or any other value.
        target: Name of the place, state, channel, number or value.
        term: What enters, in the unit of the target.
    """
    if kind == "force":
        place = next(p for p in system.motion.places if p.name == target)
        if place.force is None:
            parts = {"force": term, "inertia": parse_expression(place.inertia, system.known)}
            share = filled(parse_expression("force/inertia"), parts)
            return Change(rates={place.velocity: share})
        target = place.force
    if kind == "rate":
        return Change(rates={target: term})
    before = named(READING if kind == "reading" else target)
    text = "before*(1 + term)" if kind == "number" else "before + term"
    new = {target: filled(parse_expression(text), {"before": before, "term": term})}
    return Change(readings=new) if kind == "reading" else Change(names=new)


def by_formulas(change: Change, *symbols: str) -> Apply:
    """An effect that changes formulas.

    Args:
        change: Formulas in which the sizes are called ``symbols``.
        symbols: One for each component, in order.
    """
    return partial(_apply_change, change=change, symbols=symbols)


def _apply_change(
    scene: OdeScene, size: Tensor, run: Run, *, change: Change, symbols: Sequence[str]
) -> OdeScene:
    return scene.with_change(change, {s: size[..., i] for i, s in enumerate(symbols)})


def with_inputs(
    change: Change, symbol: str, make: Callable[[OdeScene, Tensor], Mapping[str, Tensor]]
) -> Apply:
    """An effect that changes formulas, which use inputs made of those of the scene.

    Args:
        change: Formulas in which the first size is called ``symbol``.
        symbol: Name of the first size.
        make: Function (scene, sizes) that gives the further inputs by name, (..., num_times).
    """
    return partial(_apply_with_inputs, change=change, symbol=symbol, make=make)


def _apply_with_inputs(
    scene: OdeScene,
    size: Tensor,
    run: Run,
    *,
    change: Change,
    symbol: str,
    make: Callable[[OdeScene, Tensor], Mapping[str, Tensor]],
) -> OdeScene:
    return scene.with_further_inputs(make(scene, size), change, {symbol: size[..., 0]})


LABELS = "labels"  # place of the values of facts in a study's frame


@dataclass(frozen=True)
class RunGroups:
    """One size for all, and what each group of runs has beside it.

    A group that nobody has fitted is like all.
    """

    # "run", or the fact of the runs whose values are the groups; None: no groups
    per: str | None = None
    labels: tuple[str, ...] = ()  # values of that fact in the study

    @classmethod
    def of(cls, per: str | None, study: Study) -> RunGroups:
        """Groups of a study's runs."""
        if per is None:
            return cls()
        return cls(per, labels_of(per, study))

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the sizes."""
        if len(self.labels) < 2:
            return ("size",)
        return ("all", *(f"[{self.per}={label}]" for label in self.labels))

    def size_in(self, run: Run, size: Tensor) -> Tensor:
        """Size in a run, () or (K,), of all sizes (..., num_components)."""
        own = size[..., 0]
        if self.per is None or len(self.labels) < 2:
            return own
        label = _label_run(self.per, run)
        if label not in self.labels:
            return own
        return own + size[..., 1 + self.labels.index(label)]


def labels_of(per: str, study: Study) -> tuple[str, ...]:
    """Values of a fact in the runs of a study, or in those that its ``frame`` is from."""
    kept = study.frame.get(LABELS, {}).get(per)
    return tuple(kept or dict.fromkeys(_label_run(per, run) for run in study.runs))


def labels_of_blocks(blocks: Iterable[OwnEffect | Law], study: Study) -> dict[str, list[str]]:
    """Values of the facts that own causes and laws are sized by, as a ``frame`` keeps them."""
    pers = {block.per for block in blocks if block.per is not None}
    return {per: list(labels_of(per, study)) for per in sorted(pers)}


def _label_run(per: str, run: Run) -> str:
    return run.name if per == "run" else str(run.setup.get(per))


def apply_in_group(
    scene: OdeScene, size: Tensor, run: Run, *, change: Change, symbol: str, groups: RunGroups
) -> OdeScene:
    """A scene in which formulas are changed, by the size of the run's group."""
    return scene.with_change(change, {symbol: groups.size_in(run, size)})
