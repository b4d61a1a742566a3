"""The camera of the balls: a pinhole with radial distortion, turned a little from a first guess."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from diffsim.core.rotation import skew

WIDTH_PX, HEIGHT_PX = 1280.0, 720.0


def plain_camera(size_px: Sequence[float] = (WIDTH_PX, HEIGHT_PX)) -> dict[str, Tensor]:
    """Numbers of an undistorted camera, its axis in the middle of a picture of this size."""
    middle = {"center_u": 0.5 * (size_px[0] - WIDTH_PX), "center_v": 0.5 * (size_px[1] - HEIGHT_PX)}
    return {n: torch.tensor(v, dtype=torch.float64) for n, v in {"radial": 0.0, **middle}.items()}


def projected(values: Mapping[str, Tensor], rotation: Tensor, place: Tensor) -> Tensor:
    """Pixels of places: Y = turn R p + shift, u = u0 + f b Y0 / Y2, v = v0 - f b Y1 / Y2.

    b = 1 + radial (Y0^2 + Y1^2) / Y2^2; Y2 is negative in front of the camera. The middle of the
    picture is that of the measured video, moved by center_u and center_v.

    Args:
        values: "focal" [px], "turn_x" to "turn_z" [rad], "shift_x" to "shift_z" [m], "radial" [-],
            "center_u" and "center_v" [px], (...,) each.
        rotation: Rotation R from the world to the camera, (3, 3).
        place: Places in the world over time, (..., T, 3) [m].

    Returns:
        (..., T, 2) u to the right, v down [px].
    """
    turned, shift = _make_pose(values, rotation)
    camera = place @ turned.transpose(-1, -2) + shift[..., None, :]
    flat = camera[..., :2] / camera[..., 2:]
    bent = 1.0 + values["radial"][..., None] * (flat**2).sum(-1)
    flat = values["focal"][..., None, None] * bent[..., None] * flat
    middle_u = 0.5 * WIDTH_PX + values["center_u"][..., None]
    middle_v = 0.5 * HEIGHT_PX + values["center_v"][..., None]
    return torch.stack([middle_u + flat[..., 0], middle_v - flat[..., 1]], -1)


def eye(values: Mapping[str, Tensor], rotation: Tensor) -> Tensor:
    """Place of the camera, (..., 3) [m]; arguments as for ``projected``."""
    turned, shift = _make_pose(values, rotation)
    return -(turned.transpose(-1, -2) @ shift[..., None])[..., 0]


def on_plane(
    values: Mapping[str, Tensor], rotation: Tensor, pixels: Tensor, height: float
) -> Tensor:
    """x, y (..., 2) [m] on the plane z = ``height`` of pixels (..., 2); without distortion."""
    turned, _ = _make_pose(values, rotation)
    at = eye(values, rotation)
    a = (pixels[..., 0] - 0.5 * WIDTH_PX - values["center_u"]) / values["focal"]
    b = (0.5 * HEIGHT_PX + values["center_v"] - pixels[..., 1]) / values["focal"]
    ray = torch.stack([a, b, torch.ones_like(a)], -1) @ turned
    return at[:2] + ray[..., :2] * ((height - at[2]) / ray[..., 2])[..., None]


def in_free_flight(
    values: Mapping[str, Tensor], rotation: Tensor, pixels: Tensor, time: Tensor, gravity: float
) -> Tensor:
    """Places (T, 3) [m] of what falls freely, by its pixels (T, 2), NaN where unseen.

    One camera does not see how far away a ball is; the curve of its fall tells. The pixels are
    linear in place and velocity at the start, so least squares find both, without distortion.

    Args:
        values, rotation: As for ``projected``.
        pixels: Where it was seen, six samples or more [px].
        time: Times of the samples, (T,) [s].
        gravity: Downwards along z [m/s^2].

    Returns:
        Places at all times; NaN where it was seen too rarely.
    """
    turned, shift = _make_pose(values, rotation)
    a = (pixels[:, 0] - 0.5 * WIDTH_PX - values["center_u"]) / values["focal"]
    b = (0.5 * HEIGHT_PX + values["center_v"] - pixels[:, 1]) / values["focal"]
    t = time - time[0]
    fallen = torch.stack([torch.zeros_like(t), torch.zeros_like(t), -0.5 * gravity * t**2], -1)
    known = fallen @ turned.T + shift
    rows = torch.cat([turned[i] - c[:, None] * turned[2] for i, c in ((0, a), (1, b))])
    right = torch.cat([c * known[:, 2] - known[:, i] for i, c in ((0, a), (1, b))])
    columns = torch.cat([rows, rows * t.repeat(2)[:, None]], -1)
    seen = torch.isfinite(right)
    if int(seen.sum()) < 12:  # of two coordinates: too few to show how a ball falls
        return torch.full_like(fallen, torch.nan)
    start = torch.linalg.lstsq(columns[seen], right[seen, None], driver="gelsd").solution[:, 0]
    return start[:3] + start[3:] * t[:, None] + fallen


def _make_pose(values: Mapping[str, Tensor], rotation: Tensor) -> tuple[Tensor, Tensor]:
    turn = torch.stack([values[n] for n in ("turn_x", "turn_y", "turn_z")], -1)
    shift = torch.stack([values[n] for n in ("shift_x", "shift_y", "shift_z")], -1)
    return torch.linalg.matrix_exp(skew(turn)) @ rotation, shift
