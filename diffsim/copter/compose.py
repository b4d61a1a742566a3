"""Composition: connecting patches turns parts, adds linear constraints, inserts adapters.

Thesis 3.2.2: rotations first, because they are not linear; then patches that belong together are
constrained to coincide. The composed design has the union of the parts' parameters and the
intersection of their feasible sets.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from diffsim._check import require_choice
from diffsim.copter.adapters import TILTED, adapters_for, ports
from diffsim.copter.expressions import parse_constraint
from diffsim.copter.feasible import Constraint
from diffsim.copter.geometry import Array, rotation_rpy
from diffsim.copter.parts import Part, make_part
from diffsim.copter.patches import aligning_rotation, misalignment
from diffsim.copter.placement import LinearForm, PlacedPart, complement
from diffsim.copter.spec import Connection, DesignSpec, PartSpec

_SQUARE = 0.01  # a motor that deviates by less needs no clip [deg]
Target = tuple[LinearForm, float]


class Composer:
    """Builds placed parts, constraints and starting targets from a specification.

    Attributes:
        placed: Parts by name, in the order in which they joined.
        constraints: All of them.
        explicit: Forms and values that the author gave as a start.
        defaults: Starts that the database gave.
    """

    def __init__(self, spec: DesignSpec):
        self.spec = spec
        self.placed: dict[str, PlacedPart] = {}
        self.constraints: list[Constraint] = []
        self.explicit: list[Target] = []
        self.defaults: list[Target] = []
        self._specs = {part.name: part for part in spec.parts}
        self._parts = {part.name: self._make(part) for part in spec.parts}

    def compose(self) -> None:
        """Place all parts, make all connections, read all relations.

        Raises:
            ValueError: unknown names, parts that face the wrong way, parts connected to nothing.
            MeshError: a part that is not closed.
        """
        roots = [p.name for p in self.spec.parts if p.anchored] or [self.spec.parts[0].name]
        for part in self.spec.parts:
            if part.rotation is not None or part.name in roots:
                self._place(part.name, rotation_rpy(part.rotation or (0.0, 0.0, 0.0)))
        for name in roots:
            position = self._specs[name].place or (0.0, 0.0, 0.0)
            for axis, value in zip(self.placed[name].position_names, position, strict=True):
                self._equal(LinearForm({axis: 1.0}), value, f"anchor of {name}")
        for connection in self.spec.connections:
            self._connect(connection)
        loose = [name for name in self._parts if name not in self.placed]
        if loose:
            raise ValueError(
                f"part {loose[0]!r} is connected to nothing; connect it to a part that comes "
                "before, or give it a rotation and a place"
            )
        for first, second in self.spec.rigid:
            self._rigid(first, second)
        for text in self.spec.constraints:
            self.constraints.append(parse_constraint(text, self.require_name))

    def require_name(self, name: str) -> str:
        """A parameter's full name, or an error that offers the closest one."""
        part, _, parameter = name.partition(".")
        require_choice("part", part, self.placed)
        placed = self.placed[part]
        known = [n.partition(".")[2] for n in (*placed.shape_names, *placed.position_names)]
        require_choice(f"parameter of {part}", parameter, known)
        return name

    def form(self, name: str) -> LinearForm:
        """A parameter as a linear form."""
        return LinearForm({self.require_name(name): 1.0})

    def _make(self, spec: PartSpec) -> Part:
        options: dict[str, Any] = dict(spec.options)
        if "file" in options and self.spec.folder is not None:
            options["file"] = self.spec.folder / options["file"]
        try:
            part = make_part(spec.kind, options)
        except (ValueError, TypeError) as error:
            raise type(error)(f"part {spec.name!r}: {error}") from error
        for name in spec.bounds:
            require_choice(f"bounds of {spec.name}", name, [p.name for p in part.parameters])
        return part.with_bounds(spec.bounds)

    def _place(self, name: str, rotation: Array) -> None:
        self._add(name, self._parts[name], rotation)
        spec = self._specs[name]
        placed = self.placed[name]
        if spec.place is not None:
            for axis, value in zip(placed.position_names, spec.place, strict=True):
                self.explicit.append((LinearForm({axis: 1.0}), value))
        if spec.kind == "motor" and spec.propeller:
            blades = make_part("propeller", {"rotor": spec.options.get("rotor", "kde2814_10in")})
            self._add(f"{name}__propeller", blades, rotation, automatic=True)
            self._face(placed, "shaft", self.placed[f"{name}__propeller"], "hub")

    def _add(self, name: str, part: Part, rotation: Array, automatic: bool = False) -> None:
        part.require_closed(name)
        rotation = np.where(
            np.abs(rotation - np.rint(rotation)) < 1e-14, np.rint(rotation), rotation
        )
        placed = PlacedPart(name, part, rotation, automatic)
        self.placed[name] = placed
        given = self._specs[name].options if name in self._specs else {}
        for parameter, full in zip(part.parameters, placed.shape_names, strict=True):
            stage = self.explicit if parameter.name in given else self.defaults
            stage.append((LinearForm({full: 1.0}), parameter.value))
        rows, bounds = part.feasible
        for row, bound in zip(rows, bounds, strict=True):
            form = LinearForm(dict(zip(placed.shape_names, row, strict=True)))
            label = f"{name}: {_describe(form, bound)}"
            self.constraints.append(form.at_most(LinearForm({}, float(bound)), label))

    def _connect(self, connection: Connection) -> None:
        """Align, constrain, insert adapters; the host is the end that is placed already."""
        ends = self._ends(connection)
        places = [connection.at, connection.guest_at]
        if ends[0][0] not in self.placed:
            if ends[1][0] not in self.placed:
                raise ValueError(
                    f"connection {connection.host} - {connection.guest}: neither part has a place "
                    "yet; connect one of them to a part that comes before"
                )
            ends.reverse()
            places.reverse()
        (host_name, host_patch), (guest_name, guest_patch) = ends
        host, end = self.placed[host_name], self._part(guest_name).patches[guest_patch]
        kinds = list(
            adapters_for(host.patch(host_patch), end)
            if connection.adapters is None
            else connection.adapters
        )
        turns = {"flat": connection.angle, "circular": connection.roll}
        at, slide = places[0], connection.slide
        radius = max(host.patch(host_patch).radius, end.radius)
        stem = f"{host_name}__{guest_name}"
        while kinds or self._needs_clip(guest_name, host, host_patch):
            kind = kinds.pop(0) if kinds else TILTED
            options: dict[str, Any] = {"rod_diameter": 2.0 * radius} if radius > 0.0 else {}
            options = options if kind == "round_connector" else {}
            shape = host.patch(host_patch).shape
            degrees = turns.pop(shape, 0.0)
            if kind == TILTED:
                options["normal"] = self._clip_normal(guest_name, host, host_patch, degrees)
            part = make_part(kind, options)
            entry, leave = ports(list(part.patches), shape, "flat" if kinds else end.shape)
            adapter = self._free_name(stem)
            self._add(
                adapter,
                part,
                aligning_rotation(
                    host.patch(host_patch), host.rotation, part.patches[entry], degrees=degrees
                ),
                automatic=True,
            )
            self._face(host, host_patch, self.placed[adapter], entry, at, None, slide)
            host, host_patch = self.placed[adapter], leave
            at, slide = None, None
        degrees = turns.pop(host.patch(host_patch).shape, 0.0)
        if guest_name not in self.placed:
            patch = host.patch(host_patch)
            self._place(guest_name, aligning_rotation(patch, host.rotation, end, degrees=degrees))
        guest = self.placed[guest_name]
        self._face(host, host_patch, guest, guest_patch, at, places[1], slide)

    def _face(
        self,
        host: PlacedPart,
        host_patch: str,
        guest: PlacedPart,
        guest_patch: str,
        at: Sequence[float] | None = None,
        guest_at: Sequence[float] | None = None,
        slide: bool | None = None,
    ) -> None:
        """Constrain two patches of the same place to coincide, up to where they may slide."""
        a, b = host.patch(host_patch), guest.patch(guest_patch)
        label = f"connection {host.name}.{host_patch} - {guest.name}.{guest_patch}"
        off = misalignment(a, host.rotation, b, guest.rotation)
        if off > 0.05:
            raise ValueError(
                f"{label}: the patches are {off:.3g} degrees off; turn one part by angle, roll or "
                "rotation"
            )
        if at is not None and len(at) != len(a.slides):
            raise ValueError(
                f"{label}: at must hold {len(a.slides)} numbers for {host.name}.{host_patch}, got "
                f"{len(at)}"
            )
        if guest_at is not None and len(guest_at) != len(b.slides):
            raise ValueError(
                f"{label}: guest_at must hold {len(b.slides)} numbers for "
                f"{guest.name}.{guest_patch}, got {len(guest_at)}"
            )

        def gap(direction: Array) -> LinearForm:
            return guest.coordinate(b.center, direction) - host.coordinate(a.center, direction)

        sliding: list[Array] = []
        offset = np.zeros(3)
        for owner, patch, places, sign, wanted in (
            (host, a, at, 1.0, slide),
            (guest, b, guest_at, -1.0, None),
        ):
            moves = patch.slides_by_default if wanted is None else wanted
            for k, way in enumerate(patch.slides):
                direction = sign * (owner.rotation @ way.direction)
                place = 0.0 if places is None else float(places[k])
                if not moves:
                    offset = offset + place * direction
                    continue
                sliding.append(direction)
                reach = owner.half_extent(way)
                for form in (gap(direction), -1.0 * gap(direction)):
                    self.constraints.append(form.at_most(reach, f"{label}: within {owner.name}"))
                stage = self.defaults if places is None else self.explicit
                stage.append((gap(direction), place))
        sliding = _distinct(sliding)
        for direction in complement(sliding, host.rotation @ a.reference):
            self._equal(gap(direction), float(direction @ offset), label)

    def _rigid(self, first: str, second: str) -> None:
        for name in (first, second):
            if self._specs[require_choice("rigid part", name, self._specs)].place is None:
                raise ValueError(f"rigid pair {first}, {second}: give {name!r} a place")
        a, b = self._specs[first].place, self._specs[second].place
        pairs = zip(
            self.placed[first].position_names,
            self.placed[second].position_names,
            a or (),
            b or (),
            strict=True,
        )
        for name_a, name_b, value_a, value_b in pairs:
            form = LinearForm({name_b: 1.0, name_a: -1.0})
            self._equal(form, value_b - value_a, f"rigid pair {first} - {second}")

    def _equal(self, form: LinearForm, value: float, label: str) -> None:
        self.constraints.append(form.equals(value, label))

    def _part(self, name: str) -> Part:
        return self.placed[name].part if name in self.placed else self._parts[name]

    def _ends(self, connection: Connection) -> list[tuple[str, str]]:
        """Part and patch of both ends; the closest fitting pair where patches are not named."""
        choices: list[list[tuple[str, str]]] = []
        for text in (connection.host, connection.guest):
            name, _, patch = text.partition(".")
            require_choice("part in a connection", name, [*self._parts, *self.placed])
            patches = self._part(name).patches
            if patch:
                require_choice(f"patch of {name}", patch, patches)
            choices.append([(name, p) for p in patches if patch in ("", p)])
        pairs = [pair for pair in itertools.product(*choices) if self._fits(*pair)]
        if not pairs:
            adapters_for(*(self._part(n).patches[p] for n, p in (choices[0][0], choices[1][0])))
        return list(
            min(pairs or itertools.product(*choices), key=lambda pair: self._distance(*pair))
        )

    def _fits(self, host: tuple[str, str], guest: tuple[str, str]) -> bool:
        try:
            adapters_for(*(self._part(name).patches[patch] for name, patch in (host, guest)))
        except ValueError:
            return False
        return True

    def _distance(self, host: tuple[str, str], guest: tuple[str, str]) -> float:
        return float(np.linalg.norm(self._start_of(*host) - self._start_of(*guest)))

    def _start_of(self, name: str, patch: str) -> Array:
        part = self._part(name)
        spec = self._specs.get(name)
        local = part.patches[patch].center.at(part.values)
        if name in self.placed:
            local = self.placed[name].rotation @ local
        return local + np.asarray((spec.place if spec else None) or (0.0, 0.0, 0.0))

    def _base_normal(self, motor: str) -> Array:
        """Normal that the carrier of a tilted motor must have, unit, design frame."""
        direction = np.asarray(self._specs[motor].direction, dtype=np.float64)
        mount = self._part(motor).rotor_mount
        if mount is None:
            raise ValueError(f"part {motor!r} has a direction but is no motor")
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            raise ValueError(f"direction of {motor!r} must not be zero")
        base = self._part(motor).patches["base"].axis
        return -(base @ mount.direction) * direction / length

    def _clip_normal(self, motor: str, host: PlacedPart, host_patch: str, degrees: float) -> Array:
        """Normal of the clip's top in the clip's frame."""
        bottom = make_part(TILTED, {"normal": (0.0, 0.0, -1.0)}).patches["bottom"]
        rotation = aligning_rotation(host.patch(host_patch), host.rotation, bottom, degrees=degrees)
        return rotation.T @ self._base_normal(motor)

    def _needs_clip(self, guest: str, host: PlacedPart, host_patch: str) -> bool:
        """Whether a motor with a direction of its own is not yet square to what carries it."""
        spec = self._specs.get(guest)
        if spec is None or spec.direction is None or host.patch(host_patch).shape != "flat":
            return False
        normal = host.rotation @ host.patch(host_patch).axis
        wanted = self._base_normal(guest)
        angle = np.arctan2(np.linalg.norm(np.cross(normal, wanted)), normal @ wanted)
        return bool(np.rad2deg(angle) > _SQUARE)

    def _free_name(self, name: str) -> str:
        taken = {*self.placed, *self._parts}
        numbered = (f"{name}_{k}" for k in itertools.count(2))
        return name if name not in taken else next(n for n in numbered if n not in taken)


def _distinct(directions: list[Array]) -> list[Array]:
    """Directions without those that are parallel to an earlier one."""
    result: list[Array] = []
    for direction in directions:
        if all(abs(direction @ other) < 1.0 - 1e-9 for other in result):
            result.append(direction)
    return result


def _describe(form: LinearForm, bound: float) -> str:
    terms = [(n.partition(".")[2], c) for n, c in form.coefficients.items() if c != 0.0]
    if len(terms) == 1:
        name, c = terms[0]
        return f"{name} <= {bound / c:g}" if c > 0.0 else f"{name} >= {bound / c:g}"
    return " + ".join(f"{c:g} {n}" for n, c in terms) + f" <= {bound:g}"
