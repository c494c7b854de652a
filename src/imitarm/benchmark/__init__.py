"""Benchmarks: they make random scenes and recordings from seeds, run the methods, save the results and print tables."""
