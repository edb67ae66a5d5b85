"""The R3F pipeline: geometry from masks, its index of refraction, and a report on both.

`chain` runs the stages; `records` stores the result of each stage for users and for later stages.
"""
