"""Commands that train, evaluate and render; run them as modules from the repository."""
