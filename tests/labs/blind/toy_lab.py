"""The toy as a laboratory of sealed cases: fast, so that the whole procedure can be tested."""

from __future__ import annotations

from typing import Any, ClassVar

from labs.blind.sealed import Bench, Blindfold
from labs.virtual.common import LabCase, LabEffect
from tests.diagnose import toy

_DECOYS: dict[str, dict[str, Any]] = {
    "heavy_tails": {"tails": True},
    "spikes": {"spikes": True},
    "colored_noise": {"color": 0.7},
    "far_prior": {"far_base": 1.5},
    "lost_repeat": {"lost_repeat": True},
    "gaps": {},
    "scatter": {"scatter": 0.15},
}


class ToyLab:
    """The generator of ``tests.diagnose.toy`` with the methods of a ``Lab`` that sealing uses."""

    effects: ClassVar[dict[str, LabEffect]] = {
        **{e.name: LabEffect("-", 0.5 * e.typical, "") for e in toy.LIBRARY},
        "pulse": LabEffect("-", 0.3, "a push at 1.7 s", outside=True),
    }

    def case(self, seed, effects=None, decoys=(), *, noise=1.0):
        """As ``Lab.case``."""
        hidden = {name: size[0] for name, size in (effects or {}).items()}
        options = {k: v for name in decoys for k, v in _DECOYS[name].items()}
        study = toy.generate(seed, hidden, noise=noise, **options)
        return LabCase(study, {"effects": hidden, "decoys": list(decoys)})


TOY = Bench(
    ToyLab,  # type: ignore[arg-type]
    confounded=((("delay", "lag"), Blindfold(without_runs=("steps",))),),
    invisible=(("scale", Blindfold(blank=("velocity_m_s",))),),
    look_alike=("delay", "lag"),
    coarse={"time_step": 8.0},
)
