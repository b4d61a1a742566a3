"""From the numbers of a described rod to stiffness, weight and tension of its elements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.rotation import matrix_from_rotation_vector
from diffsim.systems.rod.layout import RodLayout
from diffsim.systems.rod.statics import RodStatics

SOFTEST = 1e-4  # flexible share of what a clamp grips, so that its stiffness stays finite
SHEAR_CORRECTION = 0.9  # of a round section
_ONE = torch.zeros(1, 1, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Numbers:
    """Numbers by name, (K, 1) each; a number that nobody gave is 0."""

    given: Mapping[str, Tensor]

    @classmethod
    def of(cls, numbers: Mapping[str, Tensor]) -> Numbers:
        """Numbers () or (K,) with an axis for the poses behind."""
        return cls({k: (v if v.ndim else v[None])[:, None] for k, v in numbers.items()})

    @property
    def count(self) -> int:
        """Number of points K."""
        return max((v.shape[0] for v in self.given.values()), default=1)

    def __getitem__(self, name: str) -> Tensor:
        return self.given.get(name, _ONE)

    def stacked(self, *names: str) -> Tensor:
        """Several numbers along a last axis, (K, 1, n)."""
        if not names:
            return _ONE[..., None][..., :0]
        return torch.stack(torch.broadcast_tensors(*(self[n] for n in names)), -1)

    def each(self, names: tuple[str, ...], key: str) -> Tensor:
        """KEY of all, and what NAME_KEY adds to it, (K, 1, n)."""
        return self[key][..., None] + self.stacked(*(f"{n}_{key}" for n in names))


def rod_of(layout: RodLayout, given: Mapping[str, Tensor], command: Tensor) -> RodStatics:
    """The rod with axes (K, num_samples) in front.

    Args:
        layout: Elements, paths, places of masses.
        given: Numbers by name, () or (K,).
        command: Commanded tensions, (num_samples, num_tendons), K in front where they differ [N].
    """
    numbers = Numbers.of(given)
    shape = layout.shape
    thicker = 1.0 + numbers["radius_offset"][..., None] / shape.radius
    flexural, stretch = _compute_stiffness(layout, numbers, thicker)
    gravity = _turn_gravity(layout, numbers)
    mass = numbers["density"][..., None] * shape.area * thicker**2 * shape.lengths
    offset, slope = _place_paths(layout, numbers)
    end = layout.paths.end + numbers["tendon_end"][..., None]
    return RodStatics(
        shape=shape,
        bending=flexural,
        stretch=stretch,
        rest=_compute_rest_strains(layout, numbers),
        stiffening=numbers["strain_stiffening"],
        weight=mass[..., None] * gravity[..., None, :],
        points=layout.masses,
        loads=_list_masses(layout, numbers)[..., None] * gravity[..., None, :],
        base=layout.base
        @ matrix_from_rotation_vector(numbers.stacked("base_twist", "base_tilt_y", "base_tilt_z")),
        place=layout.place + numbers.stacked(*(f"base_shift_{a}" for a in "xyz")),
        offset=offset,
        slope=slope,
        share=_clip_to_cells((end[..., None] - shape.edges[:-1]) / shape.lengths),
        pull=_compute_tension(layout, numbers, command),
        friction=numbers["tendon_friction"],
        wobble=numbers["tendon_wobble"],
        rubber=numbers["compression_stiffening"],
    )


def _compute_stiffness(
    layout: RodLayout, numbers: Numbers, thicker: Tensor
) -> tuple[Tensor, Tensor]:
    """Against twist and bends [N m^2], and against stretch and shear [N], (K, 1, N, 3) each."""
    shape = layout.shape
    along = shape.middles / shape.length - 0.5
    modulus = numbers["youngs_modulus"][..., None]
    modulus = modulus * (1.0 + numbers["tip_stiffness"][..., None] * along)
    grip = numbers["clamped_length"][..., None]
    free = ((shape.edges[1:] - grip) / shape.lengths).clamp(0.0, 1.0)
    modulus = modulus / (SOFTEST + (1.0 - SOFTEST) * free)
    bend = modulus * shape.inertia * thicker**4
    axial = modulus * shape.area * thicker**2
    shear = 0.5 / (1.0 + numbers["poissons_ratio"][..., None])  # modulus over Young's
    twist = 2.0 * shear * bend * (1.0 + numbers["twist_stiffness"][..., None])
    slide = SHEAR_CORRECTION * shear * axial
    pulled = axial * (1.0 + numbers["stretch_stiffness"][..., None])
    return (
        torch.stack(torch.broadcast_tensors(twist, bend, bend), -1),
        torch.stack(torch.broadcast_tensors(pulled, slide, slide), -1),
    )


def _compute_rest_strains(layout: RodLayout, numbers: Numbers) -> Tensor:
    """Strains without loads, (K, 1, N, 3) [1/m]: local z is where a bend about -y leads."""
    bend = numbers.stacked("rest_bend_y", "rest_bend_z")[..., None, :]
    strain = torch.stack([0.0 * bend[..., 0], -bend[..., 1], bend[..., 0]], -1)
    return strain.expand(*strain.shape[:-2], len(layout.shape.radius), 3)


def _turn_gravity(layout: RodLayout, numbers: Numbers) -> Tensor:
    turn = matrix_from_rotation_vector(numbers.stacked(*(f"gravity_tilt_{a}" for a in "xyz")))
    return (turn @ layout.gravity[:, None])[..., 0]


def _list_masses(layout: RodLayout, numbers: Numbers) -> Tensor:
    """(K, 1, P) masses of the points [kg]."""
    own = numbers.stacked(*(f"{name}_mass" for name in layout.masses.names))
    is_marker = [name in layout.markers.names for name in layout.masses.names]
    share = torch.tensor(is_marker, dtype=torch.float64)
    return own + share * numbers["marker_mass"][..., None]


def _clip_to_cells(x: Tensor) -> Tensor:
    """Clamped to [0, 1]. At either end the slope is the mean of both sides: what ends at an edge
    lies at the end of one cell and at the begin of the next, whose slopes add up."""
    return 0.5 * (x.abs() - (x - 1.0).abs() + 1.0)


def _compute_tension(layout: RodLayout, numbers: Numbers, command: Tensor) -> Tensor:
    """(K, num_samples, T) tension at the base [N]."""
    names = layout.paths.names
    gain = numbers.stacked(*(f"{n}_gain" for n in names))
    wanted = gain * command
    others = wanted.sum(-1, keepdim=True) - wanted
    wanted = wanted + numbers["tendon_crosstalk"][..., None] * others
    loss = numbers.each(names, "drive_loss")
    # a tendon never pushes; one at rest is pulled as soon as others share with it
    at_rest = torch.where(loss > 0.0, 0.0, wanted.clamp(min=0.0))
    pulled = torch.where(wanted > 0.0, (wanted - loss).clamp(min=0.0), at_rest)
    held = numbers.each(names, "pretension")
    return torch.where(held == 0.0, pulled, torch.maximum(pulled, held))


def _place_paths(layout: RodLayout, numbers: Numbers) -> tuple[Tensor, Tensor]:
    """Offsets [m] and slopes of the tendons, (K, 1, T, N, 3)."""
    paths, names = layout.paths, layout.paths.names
    if not names:
        return paths.offset, paths.slope
    helix = numbers["tendon_helix"][..., None, None]
    angle = numbers.each(names, "tendon_turn")[..., None] + helix * layout.shape.middles
    cosine, sine = torch.cos(angle), torch.sin(angle)
    outward = paths.offset / paths.offset.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    moved = paths.offset + numbers.each(names, "tendon_distance")[..., None, None] * outward
    offset = _turn_around_axis(cosine, sine, moved)
    around = torch.stack([0.0 * offset[..., 1], -offset[..., 2], offset[..., 1]], -1)
    slope = _turn_around_axis(cosine, sine, paths.slope) + helix[..., None] * around
    return offset, slope


def _turn_around_axis(cosine: Tensor, sine: Tensor, r: Tensor) -> Tensor:
    """(..., 3) turned around x by an angle whose cosine and sine are given, (...)."""
    x, y, z = torch.broadcast_tensors(r, cosine[..., None])[0].unbind(-1)
    return torch.stack([x, cosine * y - sine * z, sine * y + cosine * z], -1)
