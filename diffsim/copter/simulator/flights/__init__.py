"""Missions (YAML) and recorded sticks (CSV) that come with the package."""
