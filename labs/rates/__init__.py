"""Rates of right and wrong answers: sealed cases of many systems, diagnosed and counted."""
