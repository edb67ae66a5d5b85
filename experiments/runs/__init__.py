"""Training runs: how they are configured, trained, measured and compared."""
