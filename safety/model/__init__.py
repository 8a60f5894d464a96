"""Fit model sets to recorded data: predictors of a robot's motion, with their error bounds."""
