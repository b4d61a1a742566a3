"""The answer as it is read and saved: probabilities, sizes, tables, sentences, the report."""
