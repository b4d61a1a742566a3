"""Stokes flow in embedded geometry: shapes, flow layer, devices (thesis 4.2)."""
