"""What may be said of the causes: one verdict, faced with runs that were not fitted."""
