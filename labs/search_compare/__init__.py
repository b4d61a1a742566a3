"""Two versions of the search on the same drawn cases: what is right, open, wrong, and its cost."""
