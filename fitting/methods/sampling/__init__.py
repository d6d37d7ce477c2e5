"""Samples of a posterior, and whether they are enough."""
