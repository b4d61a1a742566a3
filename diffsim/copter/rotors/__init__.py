"""Rotor models fitted to bench tables, one YAML file each; `python -m diffsim.copter.fit_rotor`."""
