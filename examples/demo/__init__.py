"""The demo: a silicone beam, measured against simulated, on one page (``diffsim demo``).

Read :mod:`examples.demo.story` first: it runs the stages in their order.
"""

from examples.demo.story import load_study, main, run

__all__ = ["load_study", "main", "run"]
