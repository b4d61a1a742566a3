"""Laboratories and hidden cases: where the truth is known, and a diagnosis has to find it.

They stand beside the package, which knows nothing of them, and are read from a clone's root:

- ``labs.virtual``: laboratories that compute recordings with causes hidden in them;
- ``labs.systems``: their setups, given to ``diffsim diagnose`` as anybody's: ``--setup FILE.py``;
- ``labs.rates``: sealed cases of every kind of system, counted (``python -m labs.rates``);
- ``labs.unlisted``: laws that no library lists, hidden and counted (``python -m labs.unlisted``);
- ``labs.calibration``: their answers with other thresholds (``python -m labs.calibration``);
- ``labs.cases``: chosen cases of each laboratory, with their verdicts;
- ``labs.outside``: cases that other people's simulators made (``python -m labs.outside``);
- ``labs.loop``: the loop of the thesis on the starfish, and the virtual laboratory that it runs on;
- ``labs.balls``: the thesis's two soft balls on a table, from tracks or a film to a fit.
"""
