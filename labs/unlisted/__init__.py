"""Causes that no library lists: hidden laws of many kinds, diagnosed and held against the truth."""
