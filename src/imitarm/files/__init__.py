"""Text and numbers on disk: one atomic writer, tables, files that grow line by line."""
