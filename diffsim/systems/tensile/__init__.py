"""Pull tests: one uniaxial stretch, in closed form."""
