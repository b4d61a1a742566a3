"""A controller that learned in diffsim, flown in RotorPy."""
