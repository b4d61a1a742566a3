"""Composition: connecting patches turns parts, adds linear constraints, inserts adapters.

Thesis 3.2.2: rotations first, because they are not linear; then patches that belong together are
constrained to coincide. The composed design has the union of the parts' parameters and the
intersection of their feasible sets.

Motors with a direction of their own stand on compound-angle clips (thesis 3.6, Fig. 3-4).
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from diffsim.copter.design.adapters import ADAPTERS, adapters_for, closest_pair, ports
from diffsim.copter.design.constraints import Constraint, parse_constraint
from diffsim.copter.design.contact import ContactEnd, Target, contact_of
from diffsim.copter.design.placement import LinearForm, PlacedPart
from diffsim.copter.design.spec import Connection, DesignSpec, PartSpec
from diffsim.copter.vehicle.geometry import UP, rotation_rpy
from diffsim.copter.vehicle.parts import Part, make_part
from diffsim.copter.vehicle.patches import aligning_rotation
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.errors import MeshError


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
        if len(self._specs) < len(spec.parts):
            names = [part.name for part in spec.parts]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"two parts are called {twice!r}; rename one")
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
        for part in self.spec.parts:
            if part.direction is not None:
                require_direction(part, self.placed[part.name])
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
            for name in spec.bounds:
                require_choice("bounds", name, [p.name for p in part.parameters])
            part = part.with_bounds(spec.bounds)
            part.require_start()
        except MeshError:
            raise
        except (ValueError, TypeError) as error:
            raise type(error)(f"part {spec.name!r}: {error}") from error
        return part

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
            hub = ContactEnd(self.placed[f"{name}__propeller"], "hub")
            self._touch(ContactEnd(placed, "shaft"), hub)

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
        slides = [connection.slide, None]
        label = f"connection {connection.host} - {connection.guest}"
        if ends[0][0] not in self.placed:
            if ends[1][0] not in self.placed:
                raise ValueError(
                    f"{label}: neither part has a place yet; connect one of them to a part that "
                    "comes before"
                )
            for pair in (ends, places, slides):
                pair.reverse()
        (host_name, host_patch), (guest_name, guest_patch) = ends
        host = ContactEnd(self.placed[host_name], host_patch, places[0], slides[0])
        end = self._part(guest_name).patches[guest_patch]
        kinds = connection.adapters
        if kinds is None:
            kinds = adapters_for(host.patch, end)
        turns = {"flat": connection.angle, "circular": connection.roll}
        rod_diameter = 2.0 * max(host.patch.radius, end.radius)
        for k, kind in enumerate(kinds):
            require_choice(f"{label}: adapter", kind, ADAPTERS)
            sized = kind == "round_connector" and rod_diameter > 0.0
            part = make_part(kind, {"rod_diameter": rod_diameter} if sized else {})
            following = end.shape if k == len(kinds) - 1 else "flat"
            host = self._insert(part, host, guest_name, following, turns)
        motor = self._specs.get(guest_name)
        if motor is not None and motor.direction is not None and host.patch.shape == "flat":
            clip = clip_for(motor, self._parts[guest_name], host, turns.get("flat", 0.0))
            if clip is not None:
                host = self._insert(clip, host, guest_name, end.shape, turns)
        if guest_name not in self.placed:
            degrees = turns.pop(host.patch.shape, 0.0)
            self._place(
                guest_name,
                aligning_rotation(host.patch, host.placed.rotation, end, degrees=degrees),
            )
        self._touch(host, ContactEnd(self.placed[guest_name], guest_patch, places[1], slides[1]))

    def _insert(
        self, adapter: Part, host: ContactEnd, guest: str, following: str, turns: dict[str, float]
    ) -> ContactEnd:
        """Put an adapter on a host; returns its patch that faces what follows.

        Args:
            host: Patch of the part onto which the adapter is put.
            guest: Name of the part that the whole connection is for.
            following: Shape of the patch that comes next.
            turns: Degrees by shape of patch; used up by the first contact of its shape.
        """
        entry, leave = ports(list(adapter.patches), host.patch.shape, following)
        degrees = turns.pop(host.patch.shape, 0.0)
        rotation = aligning_rotation(
            host.patch, host.placed.rotation, adapter.patches[entry], degrees=degrees
        )
        stem = host.placed.name.partition("__")[0] if host.placed.automatic else host.placed.name
        name = self._free_name(f"{stem}__{guest}")
        self._add(name, adapter, rotation, automatic=True)
        self._touch(host, ContactEnd(self.placed[name], entry))
        return ContactEnd(self.placed[name], leave)

    def _touch(self, host: ContactEnd, guest: ContactEnd) -> None:
        contact = contact_of(host, guest)
        self.constraints += contact.constraints
        self.explicit += contact.explicit
        self.defaults += contact.defaults

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
        candidates = []
        for text in (connection.host, connection.guest):
            name, _, patch = text.partition(".")
            require_choice("part in a connection", name, [*self._parts, *self.placed])
            patches = self._part(name).patches
            if patch:
                require_choice(f"patch of {name}", patch, patches)
            chosen = [p for p in patches if patch in ("", p)]
            candidates.append([(name, p, patches[p], self._start_of(name, p)) for p in chosen])
        named = all(len(ends) == 1 for ends in candidates)  # then adapters may overrule the rules
        pair = [ends[0] for ends in candidates] if named else closest_pair(*candidates)
        return [end[:2] for end in pair]

    def _start_of(self, name: str, patch: str) -> Array:
        """Where a patch is before connections have been solved (3,) [m]."""
        part, spec = self._part(name), self._specs.get(name)
        local = part.patches[patch].center.at(part.values)
        if name in self.placed:
            local = self.placed[name].rotation @ local
        return local + np.asarray((spec.place if spec else None) or (0.0, 0.0, 0.0))

    def _free_name(self, name: str) -> str:
        taken = {*self.placed, *self._parts}
        numbered = (f"{name}_{k}" for k in itertools.count(2))
        return name if name not in taken else next(n for n in numbered if n not in taken)


def _describe(form: LinearForm, bound: float) -> str:
    terms = [(n.partition(".")[2], c) for n, c in form.coefficients.items() if c != 0.0]
    if len(terms) == 1:
        name, c = terms[0]
        return f"{name} <= {bound / c:g}" if c > 0.0 else f"{name} >= {bound / c:g}"
    return " + ".join(f"{c:g} {n}" for n, c in terms) + f" <= {bound:g}"


_CLIP = "compound_angle_clip"
_SQUARE = 0.01  # a motor that deviates by less needs no clip [deg]


def clip_for(spec: PartSpec, motor: Part, host: ContactEnd, degrees: float) -> Part | None:
    """The clip between a flat patch and a motor; None if the motor stands square on it.

    Args:
        spec: Specification of the motor, with a direction.
        host: What carries the motor, placed.
        degrees: Turn of the clip about the host's normal.

    Raises:
        ValueError: no motor, or tilted too far; names the part.
    """
    wanted = _carrier_normal(spec, motor)
    if _angle(host.placed.rotation @ host.patch.axis, wanted) <= _SQUARE:
        return None
    bottom = make_part(_CLIP, {"normal": UP.tolist()}).patches["bottom"]
    rotation = aligning_rotation(host.patch, host.placed.rotation, bottom, degrees=degrees)
    try:
        return make_part(_CLIP, {"normal": (rotation.T @ wanted).tolist()})
    except ValueError as error:
        raise ValueError(f"direction of {spec.name!r} on {host.name}: {error}") from error


def require_direction(spec: PartSpec, placed: PlacedPart) -> None:
    """Refuse a direction that no connection could give, instead of dropping it.

    Raises:
        ValueError: the placed motor points elsewhere.
    """
    wanted = _carrier_normal(spec, placed.part)
    off = _angle(-placed.rotation @ placed.patch("base").axis, wanted)
    if off > 2.0 * _SQUARE:
        raise ValueError(
            f"motor {spec.name!r} points {off:.3g} degrees away from its direction; only a "
            "connection to a flat patch can tilt a motor (by a clip), and only if the motor has "
            "no rotation of its own"
        )


def _carrier_normal(spec: PartSpec, motor: Part) -> Array:
    """Normal that what carries the motor must have, unit, design frame."""
    direction = np.asarray(spec.direction, dtype=np.float64)
    mount = motor.rotor_mount
    if mount is None:
        raise ValueError(f"part {spec.name!r} has a direction but is no motor")
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        raise ValueError(f"direction of {spec.name!r} must not be zero")
    return -(motor.patches["base"].axis @ mount.direction) * direction / length


def _angle(a: Array, b: Array) -> float:
    """Between two vectors [deg]."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
