"""Is it any good? Figures that are measured, never asserted."""
