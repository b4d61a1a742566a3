"""Does a diagnosis pay? Commands made with an extended model, executed on rigs of others."""
