"""Figures, HTML reports and rerun scenes; imported by entry points, never by the simulator.

Needs the extra: ``pip install 'diffsim-robot[viz]'``. Importing this package needs nothing;
what is missing is named when it is used.
"""
