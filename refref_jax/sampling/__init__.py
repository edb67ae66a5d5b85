"""Where along a path a field is asked."""
