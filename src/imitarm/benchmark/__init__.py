"""Experiments: seeded families of scenes and recordings, runs that can be continued, saved results, tables."""
