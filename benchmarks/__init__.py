"""One script per claim. Each measures it as a ratio or a margin, and asserts it."""
