"""Examples of a source checkout; each script runs by itself, the demo is a package."""
