"""The multicopter laboratory's flights, cut short: the whole study takes 3 CPU s to fly."""

from dataclasses import replace

from labs.virtual import CopterLab


class ShortCopterLab(CopterLab):
    """Two flights of a second and a half, and the one that is held out."""

    def plans(self, rng):
        plans = [p for p in super().plans(rng) if p.name in ("sprint_a", "climb_a", "figure_eight")]
        return [replace(plan, time_s=plan.time_s[:150]) for plan in plans]
