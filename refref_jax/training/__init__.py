"""Training: one optax step, its loop, and what a run writes."""
