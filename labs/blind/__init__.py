"""Blind diagnosis: effects hidden in virtual laboratories, diagnosed unseen, and counted."""
