"""Decisions for thousands of robots at once, with arrays of any namespace of the Python array API standard.

Public arrays have the batch first, as callers have them. Inside, the batch is the *last* axis: (..., B). NumPy then
broadcasts every constant of the model set along contiguous memory, and a GPU reads neighbouring lanes together.
"""
