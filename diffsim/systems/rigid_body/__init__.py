"""A rigid cube in flight and through its first impact."""
