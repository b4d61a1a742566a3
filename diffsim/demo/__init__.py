"""The demo: silicone beam, measured against simulated (`diffsim demo`)."""
