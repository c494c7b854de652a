"""Experiments: seeded families of scenes and recordings, resumable runs, saved results, and tables."""
