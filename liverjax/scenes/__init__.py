"""Scenes: their parts, their files, their checks."""
