"""One size for several members: what is wrong with one drive may be wrong with all of them.

A tied cause is its members, one after the other, with the same size. It names them
(``Effect.members``), so that a search may take some out and tie the rest anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

from torch import Tensor

from diffsim.causes.row import spell_plainly
from diffsim.data.study import Run
from diffsim.identify.effect import Apply, Effect

MAX_PAIRED = 4  # members of a unit, up to which every pair may be exchanged


@dataclass(frozen=True, eq=False)
class Member:
    """A cause of one row as it acts on one member, such as a command."""

    row: str  # name of the row
    of: frozenset[str]  # what it acts on; members of a tie share nothing of it
    unit: str | None
    effect: Effect


def tie(effects: Sequence[Effect], name: str) -> Effect:
    """One cause that is several, all of one size.

    Args:
        effects: Causes of one row, each of one member.

    Raises:
        ValueError: fewer than two causes, or causes whose sizes are no one size.
    """
    if len({(e.unit, e.components) for e in effects}) != 1 or len(effects) < 2:
        raise ValueError(f"{name}: a tie needs two causes or more, of one unit and components")
    first = effects[0]
    return replace(
        first,
        name=name,
        apply=partial(_apply_in_turn, each=tuple(e.apply for e in effects)),
        typical=sum(e.typical for e in effects) / len(effects),
        signed=all(e.signed for e in effects),
        form=f"The same in all {len(effects)}: {first.form}",
        masks=(),
        members=tuple(e.name for e in effects),
    )


def _apply_in_turn(scene: Any, size: Tensor, run: Run, *, each: Sequence[Apply]) -> Any:
    for apply in each:
        scene = apply(scene, size, run)
    return scene


def ties(members: Sequence[Member], what: str) -> Iterator[Effect]:
    """Every row tied over all members whose sizes have one unit, where it has two or more.

    A time is one size whatever it delays; another size, or a share, is one for commands or
    channels of one unit. Where a cause acts on all of them already there is none.

    Args:
        members: Causes of rows by member, in order.
        what: What the members are together, such as "all_commands".
    """
    alike: dict[tuple[str, str | None], list[Member]] = {}
    for member in members:
        effect = member.effect
        unit = effect.unit if effect.unit == "s" else member.unit
        alike.setdefault((member.row, unit), []).append(member)
    everything = frozenset[str]().union(*(m.of for m in members))
    for (row, unit), own in alike.items():
        found = frozenset[str]().union(*(m.of for m in own))
        is_apart = sum(len(m.of) for m in own) == len(found)
        if len(own) < 2 or not is_apart or any(m.effect.components[1:] for m in own):
            continue
        # a name without a unit where there is none, or where a time is the size
        is_plain = unit is None or unit == "s" or found == everything
        ending = "" if is_plain else f"_in_{spell_plainly(unit or '')}"
        name = f"{row}_{what}" if row.endswith(("_at", "_of")) else f"{row}_of_{what}"
        yield tie([m.effect for m in own], name + ending)


def pairs(units: dict[str, str | None]) -> Iterator[tuple[str, str]]:
    """Pairs of commands or channels of one unit that may be exchanged, where these are few.

    Args:
        units: Units by name, in order.
    """
    for unit in dict.fromkeys(units.values()):
        names = [name for name, own in units.items() if own == unit]
        if len(names) <= MAX_PAIRED:
            yield from combinations(names, 2)
