"""Sealed cases: the label is drawn and hidden before any diagnosis sees the data."""
