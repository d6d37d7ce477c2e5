"""Families of models other than free Prony modes, and the choice between all models."""
