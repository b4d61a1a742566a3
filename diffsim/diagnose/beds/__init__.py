"""Testbeds of the diagnosis: for each simulator a scene with hooks, models and effects."""
