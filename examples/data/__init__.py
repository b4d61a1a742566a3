"""The silicone beam's recordings, as one reads a data set of one's own."""
