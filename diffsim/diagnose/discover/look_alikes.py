"""What laws look like: where one enters, on what it depends and its form, in the field's words."""

from __future__ import annotations

import math
from dataclasses import dataclass

from diffsim.identify.law import Law


@dataclass(frozen=True)
class LookAlike:
    """A row of the table; an empty column fits everything."""

    words: tuple[str, ...]  # what such a law may be
    kinds: tuple[str, ...] = ()  # kinds of entries
    memory: str = ""  # kind of the hidden state; "-": none
    forms: tuple[str, ...] = ()  # kinds of formulas
    units: tuple[str, ...] = ()  # units of the variable
    turns: tuple[float, float] = (0.0, math.inf)  # least and greatest wave number
    of: tuple[str, ...] = ()  # formulas of the variable

    def fits(self, law: Law) -> bool:
        """Whether a law is of this kind."""
        memory, wave = law.variable.memory or "-", law.shapes.get("wave_number")
        return (
            (not self.kinds or law.entry.kind in self.kinds)
            and (not self.memory or memory == self.memory)
            and (not self.forms or law.form in self.forms)
            and (not self.of or law.variable.formula in self.of)
            and (not self.units or law.variable.unit in self.units)
            and self.turns[0] <= (wave.value if wave else 0.0) <= self.turns[1]
        )


_RUNS = ("run_order",)
_PUSH, _NUMBER, _READ = ("force", "rate"), ("number",), ("reading",)
_ANGLE, _HEAT, _VOLT = ("rad",), ("K", "degC"), ("V",)
TABLE: tuple[LookAlike, ...] = (
    LookAlike(("zero of the sensor that drifts from run to run",), _READ, of=_RUNS),
    LookAlike(("wear", "warming up from run to run"), of=_RUNS),
    LookAlike(
        ("unbalance", "bent axis"), _PUSH, "-", ("periodic",), _ANGLE, (0.9, 1.1)
    ),  # once a turn
    LookAlike(("cogging", "eccentric gear"), _PUSH, "-", ("periodic",), _ANGLE),
    LookAlike(("ripple of the commutation", "gear"), _NUMBER, "-", ("periodic",), _ANGLE),
    LookAlike(("eccentric encoder or gear", "lead screw"), _READ, "-", ("periodic",), _ANGLE),
    LookAlike(("something that repeats",), forms=("periodic",)),
    LookAlike(("winding that warms", "oil or tire that warms"), memory="heat"),
    LookAlike(("hysteresis", "friction that remembers (Dahl)"), _PUSH, "slip"),
    LookAlike(("slosh", "absorber", "flexible part"), _PUSH, "oscillator"),
    LookAlike(("wear", "running in"), memory="work"),
    LookAlike(("creep of a load cell", "slow sensor"), _READ, "relaxation"),
    LookAlike(("relaxing material", "slow actuator"), memory="relaxation"),
    LookAlike(("what warms changes it", "radiation", "viscosity"), _NUMBER, "-", (), _HEAT),
    LookAlike(("thermal drift of the sensor",), _READ, "-", (), _HEAT),
    LookAlike(("radiation", "free convection"), ("rate",), "-", (), _HEAT),
    LookAlike(("supply that sags",), _NUMBER, "-", (), _VOLT),
    LookAlike(("cross-talk", "misaligned axes"), _READ, "-", ("line",)),
    LookAlike(("magnet", "ground effect", "wall"), _PUSH, "-", ("reciprocal",)),
    LookAlike(("stop", "valve that opens", "cable that catches"), _PUSH, "-", ("threshold",)),
    LookAlike(("dry friction, if of a speed", "limit"), _PUSH, "-", ("saturation",)),
    LookAlike(("eddy currents", "sliding tire"), _PUSH, "-", ("peak",)),
    LookAlike(("brake or clutch that engages", "relay"), (), "-", ("step",)),
    LookAlike(("iron that saturates", "limit"), (), "-", ("saturation",)),
)


def look_alikes(law: Law) -> tuple[str, ...]:
    """What a law may be, by the first row of the table that fits."""
    return next((row.words for row in TABLE if row.fits(law)), ())
