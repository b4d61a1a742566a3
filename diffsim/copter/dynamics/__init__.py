"""How a multicopter moves: hover, linear model, regulators, flight, sensors."""
