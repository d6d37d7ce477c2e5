"""Stiff and extreme cases, and runs that are interrupted."""
