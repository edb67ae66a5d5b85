"""Captures of other programs: reading, conversion to scene folders, and writing."""
