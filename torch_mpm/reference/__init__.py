"""Every op again in plain torch: the specification that the tests compare with. Slow, and differentiable to any order."""
