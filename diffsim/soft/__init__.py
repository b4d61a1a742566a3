"""Soft bodies, projective-dynamics and hyperelastic, forward and backward (thesis 4.1)."""

from diffsim.soft.body import SoftBody
from diffsim.soft.forces import elastic_energy, elastic_force
from diffsim.soft.materials import MATERIALS, lame_parameters, pd_weights
from diffsim.soft.muscles import Muscle
from diffsim.soft.options import SolverOptions
from diffsim.soft.physics import Physics
from diffsim.soft.rollout import rollout
from diffsim.soft.state import State, Trajectory
from diffsim.soft.statics import static_equilibrium
from diffsim.soft.stats import SolveStats, record_stats
from diffsim.soft.step import step

__all__ = [
    "MATERIALS",
    "Muscle",
    "Physics",
    "SoftBody",
    "SolveStats",
    "SolverOptions",
    "State",
    "Trajectory",
    "elastic_energy",
    "elastic_force",
    "lame_parameters",
    "pd_weights",
    "record_stats",
    "rollout",
    "static_equilibrium",
    "step",
]
