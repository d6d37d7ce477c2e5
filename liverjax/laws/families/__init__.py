"""Families of material laws, one a file."""
