"""A pneumatic body that bends as one arc: one bending mode, driven by a chamber."""
