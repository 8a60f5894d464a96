"""How far an actor may be ahead of the learner's permission."""

AHEAD = 1000  # steps: the actor may have its permission from an earlier learner
