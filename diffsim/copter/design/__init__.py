"""How a design is written, composed of parts, and kept feasible."""
