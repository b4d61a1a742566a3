"""Chosen cases of the virtual laboratories, and what their diagnoses find."""
