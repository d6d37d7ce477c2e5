"""Families of models besides free Prony modes, and the choice between all models."""
