"""Bodies that move: simulated and real."""
