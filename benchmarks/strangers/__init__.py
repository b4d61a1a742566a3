"""Folders as strangers would have them: recordings by independent means, one effect hidden in each.

``python -m benchmarks.strangers --out FOLDER`` writes them; the answers stand in
``docs/measured/strangers.md``.
"""
