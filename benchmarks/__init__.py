"""One script per claim. Each measures a ratio or a margin, and asserts it."""
