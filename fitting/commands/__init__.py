"""Command lines of the fits."""
