"""A common fit of several tests of one material, and the contribution of each test."""
