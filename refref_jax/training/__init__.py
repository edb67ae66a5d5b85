"""Training: configurations, their resolution, the training loop, run folders and evaluation."""
