"""Every op again in plain torch: the specification that the tests compare with, differentiable to any order."""
