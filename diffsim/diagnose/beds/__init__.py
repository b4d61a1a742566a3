"""Testbeds of the diagnosis: for each simulator its scene with hooks, its models and its effects."""
