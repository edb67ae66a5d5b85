"""The trade of speed for accuracy: points of a sweep, their table, figures and advice."""
