"""Errors against exact solutions and against float64, beside the run time they cost."""
