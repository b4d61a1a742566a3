"""Simulators with the hooks that candidate causes need."""
