"""Training scripts, what compares methods on equal terms, and the results of both."""
