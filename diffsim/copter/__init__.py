"""Multicopters: parts, composition, dynamics, hover and LQR layers, co-design, flight, fabrication.

World and body frames are north-east-down (NED): x forward, y right, z down; up is -z. The body
frame sits at the centre of mass.
"""

from diffsim.copter.vehicle import GRAVITY, Multicopter

__all__ = ["GRAVITY", "Multicopter"]
