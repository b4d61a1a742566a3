"""Damaged copies of sound records: what `check` names, with which remedy, and what it accuses."""
