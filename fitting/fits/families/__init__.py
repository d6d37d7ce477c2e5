"""Families of models beside free Prony modes, and the choice between them."""
