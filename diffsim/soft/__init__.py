"""Soft bodies, projective-dynamics and hyperelastic, forward and backward (thesis 4.1)."""

from diffsim.soft._solves import SolveStats, record_stats
from diffsim.soft.actuators import (
    ActuatorDynamics,
    ActuatorState,
    FirstOrderLag,
    RateLimit,
)
from diffsim.soft.body import SoftBody
from diffsim.soft.chambers import PressureChamber, sealed_pressure
from diffsim.soft.elements import ELEMENTS
from diffsim.soft.forces import elastic_energy, elastic_force
from diffsim.soft.hydrodynamics import Hydrodynamics, HydroForces
from diffsim.soft.immersion import added_mass, buoyancy
from diffsim.soft.materials import MATERIALS, Material, lame_parameters, pd_weights
from diffsim.soft.muscles import Muscle
from diffsim.soft.options import ContactOptions, Damping, Masses, SolverOptions
from diffsim.soft.physics import Physics
from diffsim.soft.physics_tangent import physics_directions
from diffsim.soft.rollout import rollout
from diffsim.soft.state import State, Trajectory
from diffsim.soft.statics import static_equilibrium
from diffsim.soft.step import step
from diffsim.soft.tangents import Directions, Tangents, rollout_tangents, static_tangents
from diffsim.soft.tendons import Tendon

__all__ = [
    "ELEMENTS",
    "MATERIALS",
    "ActuatorDynamics",
    "ActuatorState",
    "ContactOptions",
    "Damping",
    "Directions",
    "FirstOrderLag",
    "HydroForces",
    "Hydrodynamics",
    "Masses",
    "Material",
    "Muscle",
    "Physics",
    "PressureChamber",
    "RateLimit",
    "SoftBody",
    "SolveStats",
    "SolverOptions",
    "State",
    "Tangents",
    "Tendon",
    "Trajectory",
    "added_mass",
    "buoyancy",
    "elastic_energy",
    "elastic_force",
    "lame_parameters",
    "pd_weights",
    "physics_directions",
    "record_stats",
    "rollout",
    "rollout_tangents",
    "sealed_pressure",
    "static_equilibrium",
    "static_tangents",
    "step",
]
