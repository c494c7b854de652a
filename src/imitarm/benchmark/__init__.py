"""Benchmarks: reproducible random scenes and recordings, runs that can be resumed, saved results, and tables."""
