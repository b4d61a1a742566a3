"""Vehicles and designs of other tools' files, and vehicles by their numbers."""
