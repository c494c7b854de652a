"""Measures of a motion that was done, and their confidence intervals; for the CLI and the benchmark."""
