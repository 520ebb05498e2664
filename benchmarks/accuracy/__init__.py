"""Errors against exact solutions and against float64, with their run times."""
