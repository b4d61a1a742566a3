"""Benches: static readings as laws of what was set, described in the study."""
