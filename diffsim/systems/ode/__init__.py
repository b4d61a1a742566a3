"""Systems described by formulas: states, rates and readings, with effects that change them."""
