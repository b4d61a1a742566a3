"""Slender rods that bend far: tendon-driven arms, cables and needles in equilibrium."""
