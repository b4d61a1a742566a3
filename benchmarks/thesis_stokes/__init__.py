"""The thesis's published formulation of Stokes flow, kept for comparison (thesis 4.2.4-4.2.6)."""

from benchmarks.thesis_stokes.flow import ThesisFlow

__all__ = ["ThesisFlow"]
