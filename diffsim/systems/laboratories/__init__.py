"""The virtual laboratories of ``diffsim.data.labs`` as systems to be diagnosed."""
