"""Several tasks of one robot in one process: none changes what the others get."""

from dataclasses import replace

import numpy as np
import pytest

from messaging.tasks import learnt
from safety.filter import Filter
from tests.safety.asked import cylinder, request, same


@pytest.mark.parametrize("observed", [0, 26, 50])
def test_the_filter_decides_the_same_whichever_tasks_are_loaded(ready, observed):
    asked = replace(request(obstacles=[cylinder(0.5, 0.0)]), observation=np.ones(observed, np.float32))
    before = ready.decide(asked)
    for name in ("ground+tracks", "ground"):
        learnt(name)
        assert same(ready.decide(asked), before)
        assert same(Filter(ready.model).decide(asked), before)
