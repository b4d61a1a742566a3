"""diffsim: design robots through differentiable simulation."""

__version__ = "0.1.0"
