"""Before any physics is blamed: recordings, numerical settings, gradients, noise, repeatability."""
