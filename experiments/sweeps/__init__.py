"""The trade-off between speed and accuracy: sweeps, their tables, figures and recommendations."""
