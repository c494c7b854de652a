"""Text and numbers on disk: writing files atomically, reading tables, and files that grow line by line."""
