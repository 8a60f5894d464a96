"""Some minutes of driving state a loose bound: the tests that use them accept it, as a user would have to."""

BOUND = 0.3  # share of plans outside their tubes
WORDS = ("--accept-bound", BOUND)
