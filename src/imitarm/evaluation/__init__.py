"""Measures of executed motions, and confidence intervals; used by the CLI and the benchmark."""
