"""Text and numbers on disk: files that are written as a whole, tables of numbers, files that grow line by line."""
