"""A truth without errors, for tests that know the answer."""

from typing import Any

from labs.virtual import Lab


def exact(lab: Lab, nuisances: dict[str, Any], **effects: Any) -> dict[str, Any]:
    """Nominal base parameters, gain one, and these effects."""
    return {
        "base": {name: base.value for name, base in lab.base.items()},
        "nuisances": nuisances,
        "effects": {k: v if isinstance(v, tuple) else (v,) for k, v in effects.items()},
        "decoys": [],
        "gain": 1.0,
        "order": 0,
        "seed": 5,
    }
