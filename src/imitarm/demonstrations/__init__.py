"""Getting demonstrations ready to learn from: read, check, align."""
