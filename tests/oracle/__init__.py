"""All ops in plain torch: the specification for tests, differentiable to any order."""
