"""Rotor models fitted to bench tables, one YAML file each; `diffsim fit-rotors`."""
