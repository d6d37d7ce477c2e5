"""Families of material laws, one per file."""
