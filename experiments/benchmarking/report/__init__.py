"""The report of a benchmark: one HTML page with all tables, curves and images."""
