"""Parameters from measured and synthetic data."""
