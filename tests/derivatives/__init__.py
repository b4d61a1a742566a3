"""Every public function by every floating tensor that it takes: the right gradient, or an error."""
