"""The virtual laboratory's beam (``SoftBeamLab``): a tendon bends a clamped bar sideways."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.data.study import Run, Study
from diffsim.diagnose.beds import actuator
from diffsim.diagnose.beds.soft import forces, material, sensor
from diffsim.diagnose.beds.soft.model import SoftModel
from diffsim.diagnose.beds.soft.models import finer
from diffsim.diagnose.beds.soft.scene import SoftScene
from diffsim.diagnose.beds.soft.unknown import unknown_force
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.model import Numerics
from diffsim.diagnose.search import SearchSettings
from diffsim.diagnose.setups import DiagnosisSetup
from diffsim.diagnose.stages import DiagnosisSettings
from diffsim.diagnose.unknown import UnknownForce, smooth_covariance
from diffsim.identify import Parameter

# Far below the bar's own 250 N per strain: the tendon pulls, and hardly stiffens.
TENDON_STIFFNESS_N = 0.1
MESH_SD = 0.03  # of Young's modulus, beside the laboratory's prior: locking differs with the load
# A clamped solid cannot contract at its root, where a beam can: mid-length moves a tenth less, as
# if it were that much nearer to the clamp.
ROOT_M = 2.5e-3
KNOTS_PER_S = 5.0
FORCE_ATOL_N = 1e-11  # far below what moves a marker by a noise sd; an unloaded bar has no scale


class TensionLimit(actuator.ActuatorEffect):
    """The drive gives (1 - size) of the largest tension that any run asks for, and no more."""

    name, family, unit, typical, signed = "saturation", "shape", "-", 0.2, False
    smooth = False
    also_looks_like = ("gain, if all commands reach as high", "stiffening")

    def __init__(self, largest_N: float):
        self._largest = largest_N

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.with_command(
            lambda u, dt: torch.minimum(u, (1.0 - size[0]) * self._largest * torch.ones_like(u))
        )


class TipScale(Effect):
    """The tip's channel is larger by the share size; the other is not."""

    name, family, kind, unit, typical = "tip_scale", "sensor", "sensor", "-", 0.02
    also_looks_like = ("lens", "slipped marker", "mode shape")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        first = torch.eye(len(scene.axes), dtype=torch.float64)[0]
        return scene.with_output(lambda y, t: y * (1.0 + size[0] * first))


def causes(study: Study) -> tuple[Effect, ...]:
    """Candidates, with typical sizes for a bar of 3 cm under a newton.

    Left out: what is a base parameter (stiffness-proportional damping, placement), what the
    laboratory has no channels for (tilt and lens of cameras), a current without known drag, and
    steps of the tension (quantisation), for which there is no term.
    """
    largest = max(float(run.command["tendon_N"].max()) for run in study.runs)
    return (
        material.LossFactor(),
        _usual(material.Stiffening, 150.0),
        material.StiffnessLoss(),
        material.TemperatureDrift(),
        _usual(forces.LinearDrag, 15.0),
        _usual(forces.QuadraticDrag, 100.0),
        forces.AddedMass(),
        _usual(forces.Tilt, 0.3),
        forces.DryFriction(),
        actuator.CommandDelay(),
        actuator.Lag(),
        _usual(actuator.DeadBand, 0.1),
        _usual(actuator.Backlash, 0.05),
        TensionLimit(largest),
        sensor.SensorScale(),
        TipScale(),
    )


def setup(
    study: Study,
    *,
    cells: Sequence[int] = (10, 2, 1),
    dt_s: float = 5e-3,
    integrator: str = "implicit_midpoint",
    search: SearchSettings | None = None,
) -> DiagnosisSetup:
    """The laboratory's bar as a solid.

    Args:
        study: Of ``SoftBeamLab``.
        cells: Elements along, in the plane of bending and across; an even number in the plane.
        dt_s: Time step [s]; the samples' 10 ms must be a multiple.
        integrator: Of the body.
        search: Effort.
    """
    along, plane, across = (int(n) for n in cells)
    model = lab_beam(study, cells=(along, plane, across), dt_s=float(dt_s), integrator=integrator)
    until_s = max(float(run.time_s[-1]) for run in study.runs)
    count = round(KNOTS_PER_S * until_s) + 1
    knots = np.linspace(0.0, until_s, count)
    force = unknown_force(count, until_s, axes="y")
    in_time = smooth_covariance(knots, 2.0 * until_s / (count - 1))
    return DiagnosisSetup(
        model,
        causes(study),
        unknowns=(UnknownForce(force, np.kron(np.eye(2), in_time).astype(np.float64)),),
        bank=_bank(study),
        settings=DiagnosisSettings(
            search=search or SearchSettings(num_refits=3, max_rounds=5), accept_numerics=True
        ),
    )


def lab_beam(
    study: Study, *, cells: tuple[int, int, int], dt_s: float, integrator: str, rtol: float = 1e-8
) -> SoftModel:
    """A bar clamped at x = 0 with a tendon along it, in the middle of the elements towards +y.

    The tension is scaled so that its moment is the laboratory's; the bar is also compressed along
    its axis, which the laboratory leaves out.
    """
    told = {name: study.metadata[name] for name in ("geometry", "tendon", "markers")}
    shape, priors = told["geometry"], study.metadata["base_priors"]
    size = (float(shape["length"]), float(shape["depth"]), float(shape["width"]))
    places = {name: float(x) for name, x in told["markers"]["place_m"].items()}
    arm = float(told["tendon"]["offset_m"])

    @lru_cache(maxsize=8)
    def made(count: tuple[int, int, int], dt: float, tolerance: float) -> _Bar:
        return _Bar(size, shape, count, dt, tolerance, integrator)

    plain = made(cells, dt_s, rtol)
    young, beta = priors["youngs_modulus"], priors["rayleigh_beta"]
    factor = plain.stiffness_over_beam_theory(float(young["value"]), arm)
    young_sd = float(np.hypot(float(young["relative_sd"]), MESH_SD))
    base = [
        Parameter("youngs_modulus", float(young["value"]) / factor, young_sd, "Pa", log=True),
        Parameter("rayleigh_beta", beta["value"], beta["relative_sd"], "s", log=True),
    ]
    place_sd, zero_sd = told["markers"]["place_sd_m"], told["markers"]["zero_sd_m"]
    place_sd = float(np.hypot(float(place_sd), ROOT_M))
    base += [Parameter(f"place_{name}", 0.0, place_sd, "m") for name in places]
    runs = [run.name for run in study.runs] + [run.name for run in _bank(study)]
    jitter = float(study.metadata["gain_jitter"])
    base += [Parameter(f"gain@{run}", 1.0, jitter, "-") for run in runs]
    base += [Parameter(f"zero_{n}@{run}", 0.0, float(zero_sd), "m") for n in places for run in runs]

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        count = finer(cells, numerics.mesh)
        bar = made(count, dt_s * numerics.time_step, rtol * numerics.tolerance)
        gain = values[f"gain@{run.name}"]
        scale = arm / bar.arm / TENDON_STIFFNESS_N
        moved = torch.stack([x + values[f"place_{name}"] for name, x in places.items()])
        zeros = torch.stack([values[f"zero_{name}@{run.name}"] for name in places])
        times = torch.as_tensor(np.asarray(run.time_s), dtype=torch.float64)
        pull = torch.as_tensor(np.asarray(run.command["tendon_N"]), dtype=torch.float64)
        return SoftScene(
            body=bar.body,
            sample_times=times - times[0],
            observe=bar.look,
            axes=(1,) * len(places),
            parameters={
                "youngs_modulus": values["youngs_modulus"],
                "rayleigh_beta": values["rayleigh_beta"],
            },
            start="equilibrium",
            command=pull[:, None],
            command_dt=float(times[1] - times[0]),
            actuate=lambda tension: 1.0 - gain * scale * tension,
            friction_shares=bar.tip,
            output_maps=(lambda y, t: bar.sideways(y, moved) + zeros,),
        )

    return SoftModel(build, base, "tendon-driven bar of the laboratory")


class _Bar:
    """The bar on one mesh, its tendon and its axis."""

    def __init__(
        self,
        size: tuple[float, float, float],
        shape: Mapping[str, float],
        cells: tuple[int, int, int],
        dt_s: float,
        rtol: float,
        integrator: str,
    ):
        if cells[1] % 2:
            raise ValueError(f"cells: an even number in the plane of bending, got {cells}")
        length, depth, width = size
        box = mesh.hex_box(cells, size)
        # the layer of elements nearest to half way out, so that refining keeps the arm
        layer = depth / cells[1]
        self.arm = layer * (max(0, round(0.25 * depth / layer - 0.5)) + 0.5)
        path = [
            [0.0, 0.5 * depth + self.arm, 0.5 * width],
            [length, 0.5 * depth + self.arm, 0.5 * width],
        ]
        tendon = soft.Tendon(box, path, axial_stiffness=TENDON_STIFFNESS_N, slack=False)
        self.body = soft.SoftBody(
            box,
            dt=dt_s,
            integrator=integrator,
            youngs_modulus=2.8e5,
            poissons_ratio=float(shape["poissons_ratio"]),
            density=float(shape["density"]),
            gravity=(0.0, 0.0, 0.0),
            rayleigh_beta=1e-3,
            fixed=box.nodes_near_plane("x", 0.0),
            muscles=[tendon.muscle],
            solver=soft.SolverOptions(rtol=rtol, atol=FORCE_ATOL_N),
        )
        self.length, self.inertia = length, width * depth**3 / 12.0
        x = box.x_rest
        stations = cells[0] + 1
        self.axis = torch.stack(
            [box.nodes_near_plane("x", length * i / cells[0]) for i in range(stations)]
        )
        self.rest = x[self.axis][:, :, 1].mean(1)
        face = box.nodes_near_plane("x", length)
        self.tip = torch.zeros(box.num_vertices, dtype=torch.float64)
        self.tip[face] = 1.0 / len(face)

    def look(self, x: Tensor) -> Tensor:
        """Displacements in y of the axis at all stations, (..., num_stations) [m]."""
        return x[..., self.axis, 1].mean(-1) - self.rest

    def sideways(self, y: Tensor, places: Tensor) -> Tensor:
        """The same at ``places`` (m,) [m], (..., m), by cubics between stations."""
        spacing = self.length / (len(self.axis) - 1)
        left = (places.detach() / spacing).floor().long().clamp(1, len(self.axis) - 3)
        s = places / spacing - left
        # Lagrange through four stations around the place
        weights = torch.stack(
            [
                -s * (s - 1.0) * (s - 2.0) / 6.0,
                (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
                -(s + 1.0) * s * (s - 2.0) / 2.0,
                (s + 1.0) * s * (s - 1.0) / 6.0,
            ]
        )
        return torch.stack([weights[i] * y[..., left - 1 + i] for i in range(4)]).sum(0)

    def stiffness_over_beam_theory(self, youngs_modulus: float, arm: float) -> float:
        """How much stiffer the mesh is under a moment at the tip (locking): M L^2 / (2 E I)."""
        tension = torch.tensor([0.5 * arm / self.arm], dtype=torch.float64)
        young = torch.tensor(youngs_modulus, dtype=torch.float64)
        with torch.no_grad():
            x = self.body.static_equilibrium(
                activation=1.0 - tension / TENDON_STIFFNESS_N,
                physics=self.body.physics(youngs_modulus=young),
            ).x
            tip = self.sideways(self.look(x), torch.tensor([self.length], dtype=torch.float64))
        beam = 0.5 * arm * self.length**2 / (2.0 * youngs_modulus * self.inertia)
        return beam / float(tip[0])


def _usual(cause: Callable[[], Effect], typical: float) -> Effect:
    """The effect with another typical size."""
    own = type(cause.__name__, (cause,), {"typical": typical})  # type: ignore[arg-type, misc]
    made: Effect = own()
    return made


def _bank(study: Study) -> tuple[Run, ...]:
    """Tensions that could be commanded: a quarter, half and all of the drive, slow and fast."""
    like = study.fit_runs[0]
    t = np.asarray(like.time_s) - like.time_s[0]
    commands = {
        "release_low": 0.4 * np.clip(np.minimum(t / 0.3, (1.32 - t) / 0.04), 0.0, 1.0),
        "release_high": 1.6 * np.clip(np.minimum(t / 0.3, (1.32 - t) / 0.04), 0.0, 1.0),
        "sine_2Hz_low": 0.3 * (1.0 - np.cos(2 * np.pi * 2.0 * t)) / 2.0,
        "sine_2Hz_high": 1.5 * (1.0 - np.cos(2 * np.pi * 2.0 * t)) / 2.0,
        "sine_8Hz": 0.4 * (1.0 - np.cos(2 * np.pi * 8.0 * t)) / 2.0,
        "sine_20Hz": 0.8 * (1.0 - np.cos(2 * np.pi * 20.0 * t)) / 2.0,
    }
    empty = np.zeros_like(like.measured)
    return tuple(
        replace(like, name=f"bank_{name}", group=name, command={"tendon_N": u}, measured=empty)
        for name, u in commands.items()
    )
