"""A tendon-driven starfish on a rail: a quarter of it, and what a real one adds."""
