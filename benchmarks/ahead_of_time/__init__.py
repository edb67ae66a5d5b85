"""Programs of the library, compiled for an H100 on a machine without one, and what is counted of them."""
