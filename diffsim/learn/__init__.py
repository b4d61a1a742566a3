"""Training of controllers: through the simulator's gradient, and without it."""
