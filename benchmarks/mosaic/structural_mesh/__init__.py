"""Mosaic's domain structural-mesh: compliance of a graded cantilever, and its gradient."""
