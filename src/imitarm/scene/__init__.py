"""Where to go and what is in the way."""
