"""The stages of R3F: masks to geometry, its index of refraction, and a report on both.

`chain` goes through them, `records` is what they leave to be read by people and by one another.
"""
