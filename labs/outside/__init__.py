"""Cases made by other people's simulators: MuJoCo, RotorPy, PyElastica; optional packages."""
