"""The plain fit, and the sets of causes that are fitted and weighed by their evidence."""
