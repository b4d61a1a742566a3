"""Numbers that the library gives today, over whole populations, in a few digits each.

A change of any of them is a finding: a mistake, or an intended change that CHANGELOG.md names under
Numerics. ``python -m tests.known.renew`` writes them anew; the difference of ``numbers.json`` shows
which moved, and goes into the commit that moved them.
"""
