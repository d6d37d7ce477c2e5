"""Samples of a posterior, and a check whether there are enough of them."""
