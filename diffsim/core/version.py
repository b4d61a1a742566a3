"""The version of the package, stated here alone: pyproject.toml and the site read it."""

__version__ = "1.0.0"
