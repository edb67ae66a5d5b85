"""What must hold of any function, and of any error."""
